"""What a real base does around its linear dynamics: limits on the way in, slip on the way out.

On the way in, `TwistSlew` then `WheelCommand`; then the velocity model; on the way out, `YawRelaxation` and `Veer`.
`PoseMount` is where the pose sensor sits. Each is optional, and `respond` puts them in a row.
"""

from diffdrive_mpc.models.base_effects.body import PoseMount, Veer, YawRelaxation
from diffdrive_mpc.models.base_effects.commands import TwistSlew, WheelCommand
from diffdrive_mpc.models.base_effects.response import PARTS, BaseEffects, Response, respond

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
