"""References from pose to pose that take the least energy, time or distance: search, polish, proof."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.extras.planner.clearance import PlanError
    from diffdrive_mpc.extras.planner.inputs import OBJECTIVES, Objective
    from diffdrive_mpc.extras.planner.planner import plan, plan_each
    from diffdrive_mpc.extras.planner.result import Plan
    from diffdrive_mpc.extras.planner.search import Piece, PlanSearchResult
    from diffdrive_mpc.extras.planner.settings import PlanSettings, load_plan_settings

__all__ = [
    "OBJECTIVES",
    "Objective",
    "Piece",
    "Plan",
    "PlanError",
    "PlanSearchResult",
    "PlanSettings",
    "load_plan_settings",
    "plan",
    "plan_each",
]
__getattr__ = on_first_use(
    __name__,
    {
        "PlanError": "clearance",
        "OBJECTIVES": "inputs",
        "Objective": "inputs",
        "plan": "planner",
        "plan_each": "planner",
        "Plan": "result",
        "PlanSearchResult": "search",
        "Piece": "search",
        "PlanSettings": "settings",
        "load_plan_settings": "settings",
    },
)
