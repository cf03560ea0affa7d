"""What was asked of the controller."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive


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
