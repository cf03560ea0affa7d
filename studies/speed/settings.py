"""Settings of the speed benchmark, read from `settings.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.suggestions import format_unknown_name

Names = Annotated[tuple[str, ...], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=100_000)]
MAX_STEPS = 200
"""Maximum horizon, as in the configuration."""


class SubjectSettings(StrictModel):
    """Kind and settings of a solver."""

    kind: Literal["ours", "acados", "do-mpc", "nlpsol"]
    settings: dict[str, Any] = Field(description="configuration values for our controller, solver settings for a peer")

    @property
    def needs_environment(self) -> bool:
        """True if the subject requires the peers' environment."""
        return self.kind in ("acados", "do-mpc")


class SpeedSettings(StrictModel):
    """Problem, solvers and settings of the measurement; `settings.yaml` states the units."""

    config: dict[str, bool | int | float | str] = Field(description="configuration values of all models by dotted key")
    trajectory: str
    ticks: Count
    plant_sensors: str
    seed: Annotated[int, Field(ge=0)]
    models: Names
    horizons: Annotated[tuple[Annotated[int, Field(ge=1, le=MAX_STEPS)], ...], Field(min_length=1)]
    repetitions: Count
    block: Count
    replayed_below: Annotated[float, Field(gt=0)]
    gap_every: Count
    subjects: Annotated[dict[str, SubjectSettings], Field(min_length=1)]
    converged: SubjectSettings


QUICK: dict[str, object] = {"models": ("ssm",), "horizons": (10, 20), "ticks": 60, "repetitions": 2}
"""Reduced settings of a quick run."""


def load_speed_settings(file: Path | None = None, *, quick: bool = False) -> SpeedSettings:
    """Load settings from `file`, by default the shipped file; raise ConfigError if the file is invalid."""
    settings = load_checked(SpeedSettings, file or Path(__file__).with_name("settings.yaml"))
    return settings.model_copy(update=QUICK) if quick else settings


def select_subjects(settings: SpeedSettings, names: Sequence[str] | None) -> SpeedSettings:
    """Select subjects by name; the name of a group selects all its members, as `ours` selects `ours/auto`.

    Raise ConfigError if a name is unknown.
    """
    if names is None:
        return settings
    subjects: dict[str, SubjectSettings] = {}
    for name in names:
        members = {key: subject for key, subject in settings.subjects.items() if f"{key}/".startswith(f"{name}/")}
        if not members:
            raise ConfigError(f"--peers: unknown subject {format_unknown_name(name, settings.subjects)}")
        subjects |= members
    return settings.model_copy(update={"subjects": subjects})
