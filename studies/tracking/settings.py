"""What the tracking study runs (`study.yaml`, a quick one `quick.yaml`), and what was asked for (`targets.yaml`)."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

if TYPE_CHECKING:
    from typing import Self

Names = Annotated[tuple[str, ...], Field(min_length=1)]
Seeds = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
Value = bool | int | float | str


class TargetRuns(StrictModel):
    """Runs that show whether what was asked for is reached, with every model along every trajectory."""

    seeds: Seeds
    untuned_surfaces: Names = Field(description="floors that nothing was tuned on")
    late_sensors: str = Field(description="sensor set with late and rare poses")
    scenarios: Names = Field(description="disturbances that the robot has to recover from")


class AblationRuns(StrictModel):
    """The controller with parts left out."""

    models: Names
    surfaces: Names
    # What differs from seed to seed is noise; it takes two to see any.
    seeds: Annotated[Seeds, Field(min_length=2)]
    variants: Annotated[dict[str, dict[str, Value]], Field(min_length=1)] = Field(
        description="configuration values by dotted key, under the name of the variant"
    )
    drawn: Names = Field(description="variants that the figure of the sources of error shows")

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = [name for name in self.drawn if name not in self.variants]
        if unknown:
            raise ValueError(f"drawn: there is no variant '{unknown[0]}'; known: {', '.join(self.variants)}")
        return self


class CrossRuns(StrictModel):
    """Controllers of one model on plants of another."""

    plants: Names = Field(description="velocity models that stand in for the robot")
    seeds: Seeds


class SurfaceRuns(StrictModel):
    """Every surface with every sensor set."""

    surfaces: Names
    sensors: Names
    seeds: Seeds


class ScenarioRuns(StrictModel):
    """Every disturbance."""

    names: Names
    trajectories: Names
    seeds: Seeds


class BoundRuns(StrictModel):
    """The clairvoyant controller."""

    surfaces: Names


class TrackingSettings(StrictModel):
    """All parts. `models` and `trajectories` hold for every part that does not name its own."""

    models: Names
    trajectories: Names
    targets: TargetRuns
    ablation: AblationRuns
    cross: CrossRuns
    surfaces: SurfaceRuns
    scenarios: ScenarioRuns
    bound: BoundRuns


PARTS = ("targets", "ablation", "cross", "surfaces", "scenarios", "bound")
"""Names of the parts, in the order of the report."""


def load_study(file: Path | None = None, *, quick: bool = False) -> TrackingSettings:
    """Read a study, by default the shipped one; raises ConfigError when the file has a mistake."""
    return load_checked(TrackingSettings, file or Path(__file__).parent / ("quick.yaml" if quick else "study.yaml"))


class DefaultTargets(StrictModel):
    """On the default surface with the default sensors."""

    position_rmse: Positive
    position_aim: Positive
    arc_lateral: Positive
    course_rmse: Positive
    heading_rmse: Positive


class UntunedTargets(StrictModel):
    """On floors of other friction."""

    position_rmse: Positive
    lateral: Positive


class LateTargets(StrictModel):
    """With late and rare poses."""

    lateral: Positive


class DisturbedTargets(StrictModel):
    """After a disturbance."""

    recovery_time: Positive
    overshoot: Positive


class Targets(StrictModel):
    """Everything that was asked for; units in `targets.yaml`."""

    default: DefaultTargets
    untuned: UntunedTargets
    late: LateTargets
    disturbed: DisturbedTargets
    lateral_from: Positive


@cache
def load_targets() -> Targets:
    """Read the shipped targets; raises ConfigError when the file has a mistake."""
    return load_checked(Targets, Path(__file__).parent / "targets.yaml")
