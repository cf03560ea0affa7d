"""What a real base does around its linear dynamics: limits on the way in, slip on the way out.

On the way in, `TwistSlew` then `WheelCommand`; then the velocity model; on the way out, `YawRelaxation` and `Veer`.
`PoseMount` is where the pose sensor sits. Each is optional, and `respond` puts them in a row.
"""

from diffdrive_mpc.models.base_effects.parameters import BaseEffects
from diffdrive_mpc.models.base_effects.pose_mount import PoseMount
from diffdrive_mpc.models.base_effects.response import PARTS, Response, respond
from diffdrive_mpc.models.base_effects.twist_slew import TwistSlew
from diffdrive_mpc.models.base_effects.veer import Veer
from diffdrive_mpc.models.base_effects.wheel_command import WheelCommand
from diffdrive_mpc.models.base_effects.yaw_relaxation import YawRelaxation

__all__ = [
    "PARTS",
    "BaseEffects",
    "PoseMount",
    "Response",
    "TwistSlew",
    "Veer",
    "WheelCommand",
    "YawRelaxation",
    "respond",
]
