"""Configuration schema of the learning from repeated references."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from diffdrive_mpc.mpc.config.group import FeatureGroup, Group, NotNegative, Positive
from diffdrive_mpc.mpc.config.schema import ControllerConfig


class DrivableWeights(Group):
    """Weights of the nearest drivable path, for `rehearsal.by: floor`.

    The cost integrates the squared distance from the reference over time. Each weight converts another deviation to an
    equivalent distance.
    """

    heading: NotNegative = Field(0.01, description="weight of a heading error, as an equivalent distance [m/rad]")
    v_rate: Positive = Field(
        0.003, description="weight of a deviation from the reference's acceleration, as a distance [s^2]"
    )
    omega_rate: Positive = Field(
        0.0005,
        description="weight of a deviation from the reference's yaw acceleration, as a distance [m s^2/rad]",
    )
    end: NotNegative = Field(0.5, description="duration for which the distance at the end counts [s]")
    end_heading: NotNegative = Field(
        0.1, description="weight of the heading error at the end, as an equivalent distance [m/rad]"
    )
    min_shift: NotNegative = Field(
        0.001, description="minimum shift; a reference with a smaller shift is tracked unchanged [m]"
    )
    max_shift: Positive = Field(
        0.1, description="maximum shift; a reference with a larger shift is tracked unchanged [m]"
    )
    iterations: Annotated[int, Field(ge=1, le=10_000)] = Field(
        300,
        description="maximum number of solver iterations; if exceeded, the reference is tracked unchanged [-]",
    )


class Rehearsal(FeatureGroup):
    """Learning from laps of a repeated reference; see docs/tuning.md."""

    enabled: bool = Field(False, description="correct a repeated reference by the errors of its previous laps [-]")
    by: Literal["laps", "floor"] = Field(
        "laps",
        description="laps: correct by the errors of previous laps; floor: track the nearest path that is drivable with "
        "the learned slip, see the group drivable [-]",
    )
    gain: Annotated[float, Field(gt=0, le=1)] = Field(
        0.3, description="minimum weight of a lap's error in the correction; the first laps have equal weights [-]"
    )
    forgetting: Annotated[float, Field(ge=0, le=1)] = Field(
        0.0, description="fraction of the correction that is dropped at each lap [-]"
    )
    smoothing: Annotated[float, Field(ge=0.02, le=5)] = Field(
        0.1, description="time constant of the zero-phase smoothing of errors and correction [s]"
    )
    max_correction: Positive = Field(0.03, description="maximum correction of the position [m]")
    max_heading_correction: Positive = Field(0.1, description="maximum correction of the heading [rad]")
    max_correction_rate: Positive = Field(0.1, description="maximum rate of the correction of the position [m/s]")
    floor_change: Positive = Field(
        0.1, description="change of the slip gains, averaged over a lap, above which the correction is discarded [-]"
    )
    worse: Positive = Field(
        1.2, description="ratio of a lap's error to the first lap's error above which the correction is discarded [-]"
    )
    drivable: DrivableWeights = DrivableWeights()


def rehearsal_of(config: ControllerConfig) -> Rehearsal:
    """Return the `rehearsal` group of a configuration, with the defaults if the group is missing."""
    return config.feature_group("rehearsal", Rehearsal)
