"""The schema of the learning where the same reference is started again."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import FeatureGroup, Group, NotNegative, Positive
from diffdrive_mpc.mpc.config.schema import ControllerConfig


class DrivableWeights(Group):
    """Weights of the drivable path nearest to the reference; for rehearsal.by: floor.

    The square of a distance from the reference counts over time; the others are how much distance they are worth.
    """

    heading: NotNegative = Field(0.01, description="distance that a heading off by one radian is worth [m/rad]")
    v_rate: Positive = Field(
        0.003, description="distance that an acceleration beside the reference's is worth, by 1 m/s^2 [s^2]"
    )
    omega_rate: Positive = Field(0.0005, description="the same of the yaw rate, by 1 rad/s^2 [m s^2/rad]")
    end: NotNegative = Field(0.5, description="for so long the distance at the end counts: there the robot stands [s]")
    end_heading: NotNegative = Field(0.1, description="distance that a radian is worth at the end [m/rad]")
    min_shift: NotNegative = Field(
        0.001, description="a reference that need not be moved further than this is tracked as it is given [m]"
    )
    max_shift: Positive = Field(
        0.1, description="where it would have to be moved further than this, it is tracked as it is given [m]"
    )
    iterations: Annotated[int, Field(ge=1, le=10_000)] = Field(
        300, description="of the solver; where they do not do, the reference is tracked as it is given [-]"
    )


class Rehearsal(FeatureGroup):
    """Learning from laps when the same reference is started again; see docs/tuning.md."""

    enabled: bool = Field(False, description="correct a reference driven again by what its last laps taught [-]")
    by: Literal["laps", "floor"] = Field(
        "laps",
        description="laps: by the errors of its last laps; floor: by what can be driven on the floor as its slip was "
        "learned, see the group drivable [-]",
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        0.3, description="least share of a lap's error that enters the correction; the first laps count alike [-]"
    )
    forgetting: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="share of the correction that is lost at each lap [-]"
    )
    smoothing: Annotated[float, Field(ge=0.02, le=5)] = Field(
        0.1, description="time over which errors and the correction are averaged, without delay [s]"
    )
    max_correction: Positive = Field(0.03, description="largest correction of the position [m]")
    max_heading_correction: Positive = Field(0.1, description="largest correction of the heading [rad]")
    max_correction_rate: Positive = Field(0.1, description="largest rate of the correction of the position [m/s]")
    floor_change: Positive = Field(
        0.1, description="change of the gains of slip, averaged over a lap, at which what was learned is forgotten [-]"
    )
    worse: Positive = Field(
        1.2, description="error of a lap over that of the first at which what was learned is forgotten [-]"
    )
    drivable: DrivableWeights = DrivableWeights()


def rehearsal_of(config: ControllerConfig) -> Rehearsal:
    """Return the group of a configuration, with its defaults if the configuration does not name it."""
    return config.feature_group("rehearsal", Rehearsal)
