"""How far the robot is from what it tracks, as the estimate has it."""

from __future__ import annotations

import math

from diffdrive_mpc.mpc.reentry.path_window import in_path
from diffdrive_mpc.mpc.step_result import StepResult


def tracking_error(result: StepResult) -> tuple[float, float, float] | None:
    """Distance ahead of and to the left of the pose tracked now [m], heading error [rad]; None while nothing is."""
    if result.estimate is None or result.reference is None:
        return None
    x, y, theta = result.reference[0].tolist()
    at_x, at_y, at_theta = result.estimate.pose.tolist()
    along, across = in_path(at_x - x, at_y - y, theta)
    return float(along), float(across), math.remainder(at_theta - theta, math.tau)
