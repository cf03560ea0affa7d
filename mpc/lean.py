"""How a robot that side-slips should follow a curve: turned into it, and a little late.

To hold its path in a curve the robot must hold a heading error, the lead atan(side_slip omega). Where the heading
error costs something too, part of it is made up for by lagging behind along the path, where the tangent has turned
less: a lag d leaves the heading error lead - curvature d. In a steady curve along d^2 + heading (lead - curvature d)^2
is least at the lag that is used here. A finite horizon would not find it: it would drift off the path instead.
"""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import Weights


def lean(poses: FloatArray, twist: FloatArray, side_slip: float, weights: Weights) -> tuple[FloatArray, FloatArray]:
    """What to aim at for reference `poses` (n, 3) with `twist` (n, 2).

    Returns
    -------
    tuple
        (n, 3) the poses shifted back by the lag, theta still that of the path there; and (n,) the headings [rad] to
        hold, lead included.
    """
    v, omega = twist.T
    lead = np.arctan(side_slip * omega)
    cost = weights.along * v**2 + weights.heading * omega**2
    lag = np.divide(weights.heading * lead * omega * v, cost, out=np.zeros_like(cost), where=cost > 0)
    # The lag in arc length and in angle: curvature times lag, written so that turning on the spot is no special case.
    turn = np.divide(weights.heading * lead * omega**2, cost, out=np.zeros_like(cost), where=cost > 0)
    aim = poses.copy()
    aim[:, 0] -= lag * np.cos(poses[:, 2])
    aim[:, 1] -= lag * np.sin(poses[:, 2])
    aim[:, 2] -= turn
    return aim, aim[:, 2] + lead
