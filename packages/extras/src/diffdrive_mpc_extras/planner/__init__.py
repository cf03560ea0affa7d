"""Planning of references from pose to pose with minimum energy, time or distance: search, optimisation, check."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.planner.planner import plan as plan
    from diffdrive_mpc_extras.planner.planner import plan_each as plan_each

# Lazy import, because `diffdrive-mpc --help` imports this package.
__getattr__, __dir__ = on_first_use(__name__, {"plan": "planner", "plan_each": "planner"})
