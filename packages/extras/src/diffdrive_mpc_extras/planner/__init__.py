"""References from pose to pose that take the least energy, time or distance: search, polish, proof."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc_extras.planner.clearance import PlanError as PlanError
    from diffdrive_mpc_extras.planner.inputs import OBJECTIVES as OBJECTIVES
    from diffdrive_mpc_extras.planner.inputs import Objective as Objective
    from diffdrive_mpc_extras.planner.planner import plan as plan
    from diffdrive_mpc_extras.planner.planner import plan_each as plan_each
    from diffdrive_mpc_extras.planner.result import Plan as Plan
    from diffdrive_mpc_extras.planner.search import Piece as Piece
    from diffdrive_mpc_extras.planner.search import PlanSearchResult as PlanSearchResult
    from diffdrive_mpc_extras.planner.settings import PlanSettings as PlanSettings
    from diffdrive_mpc_extras.planner.settings import load_plan_settings as load_plan_settings

_HOMES = {
    "OBJECTIVES": "inputs",
    "Objective": "inputs",
    "Piece": "search",
    "Plan": "result",
    "PlanError": "clearance",
    "PlanSearchResult": "search",
    "PlanSettings": "settings",
    "load_plan_settings": "settings",
    "plan": "planner",
    "plan_each": "planner",
}

if not TYPE_CHECKING:  # a type checker takes the imports above for the public names
    __all__ = list(_HOMES)
__getattr__ = on_first_use(__name__, _HOMES)
