"""References from pose to pose that take the least energy, time or distance: search, polish, proof."""

from diffdrive_mpc.mpc.planner.checks import PlanError
from diffdrive_mpc.mpc.planner.inputs import OBJECTIVES, Objective
from diffdrive_mpc.mpc.planner.planner import plan, plan_each
from diffdrive_mpc.mpc.planner.result import Plan
from diffdrive_mpc.mpc.planner.search import Found, Piece
from diffdrive_mpc.mpc.planner.settings import PlanSettings, load_plan_settings

__all__ = [
    "OBJECTIVES",
    "Found",
    "Objective",
    "Piece",
    "Plan",
    "PlanError",
    "PlanSettings",
    "load_plan_settings",
    "plan",
    "plan_each",
]
