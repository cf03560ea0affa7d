"""What the torque study does: `study.yaml` says what each value is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import NotNegative, Positive, Share

PARTS = ("curves", "payload", "energy")
"""Names of the parts, in the order of the report."""

Radii = Annotated[tuple[float, ...], Field(min_length=3)]
Speeds = Annotated[tuple[Positive, ...], Field(min_length=1)]


class Diagnostic(StrictModel):
    """The drive that the networks learn from."""

    radii: Radii
    speeds: Speeds
    hold: Positive


class Measured(StrictModel):
    """Steady turns."""

    radii: Radii
    speeds: Speeds
    settling: NotNegative
    hold: Positive


class Unseen(StrictModel):
    """Drives whose energy is predicted."""

    seeds: tuple[int, ...]
    turns: int = Field(ge=1)
    hold: Positive
    ramp: NotNegative
    radii: tuple[Positive, Positive]
    speeds: tuple[Positive, Positive]


class TorqueStudySettings(StrictModel):
    """All of it."""

    robot: str = Field(description="of the physics, shipped or the path of a robot file; its file says its motors")
    vehicle: str | None = Field(default=None, description="shipped or a path; without: of the robot's name")
    prior: str
    surfaces: Annotated[tuple[str, ...], Field(min_length=1)]
    diagnostic: Diagnostic
    measured: Measured
    fit_radii: Radii
    saturated: Share
    payloads: tuple[NotNegative, ...]
    payload_surface: str
    unseen: Unseen
    seed: int = Field(ge=0)


def load_study(path: Path | None = None) -> TorqueStudySettings:
    """Read what to do; raises ConfigError on a mistake in the file."""
    return load_checked(TorqueStudySettings, path or Path(__file__).parent / "study.yaml")


def small(study: TorqueStudySettings) -> TorqueStudySettings:
    """One floor, one speed and few turns, to see that it works."""
    measured = study.measured.model_copy(
        update={"radii": study.measured.radii[::3], "speeds": (0.4,), "settling": 1.0, "hold": 1.0}
    )
    unseen = study.unseen.model_copy(update={"seeds": study.unseen.seeds[:1], "turns": 4})
    return study.model_copy(
        update={
            "surfaces": ("grippy",),
            "measured": measured,
            "unseen": unseen,
            "fit_radii": study.fit_radii[::3],
            "payloads": study.payloads[:2],
        }
    )
