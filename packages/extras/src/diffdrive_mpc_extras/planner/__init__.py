"""References from pose to pose that take the least energy, time or distance: search, polish, proof."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.planner.planner import plan as plan
    from diffdrive_mpc_extras.planner.planner import plan_each as plan_each

# Lazy: `diffdrive-mpc --help` imports this package for the help of its command.
__getattr__ = on_first_use(__name__, {"plan": "planner", "plan_each": "planner"})
