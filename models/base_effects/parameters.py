"""The optional group `base_effects` of a model file."""

from __future__ import annotations

from pydantic import Field

from diffdrive_mpc.models.base_effects.pose_mount import PoseMount
from diffdrive_mpc.models.base_effects.twist_slew import TwistSlew
from diffdrive_mpc.models.base_effects.veer import Veer
from diffdrive_mpc.models.base_effects.wheel_command import WheelCommand
from diffdrive_mpc.models.base_effects.yaw_relaxation import YawRelaxation
from diffdrive_mpc.models.checked_yaml import StrictModel


class BaseEffects(StrictModel):
    """What the base does around the linear model of the same file; an effect left out is not there."""

    twist_slew: TwistSlew | None = Field(default=None, description="acceleration limits inside the base")
    wheel_command: WheelCommand | None = Field(default=None, description="steps, coasting and top speed of the motors")
    yaw_relaxation: YawRelaxation | None = Field(default=None, description="twist of the tyres at changes of direction")
    veer: Veer | None = Field(default=None, description="yaw of the body while the wheels drive straight")
    pose_mount: PoseMount | None = Field(default=None, description="where the pose sensor sits")
