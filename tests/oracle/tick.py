"""What one tick's problem is about: where the robot is, what to aim at, and which commands would hold that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.estimation.slip import Slip
from oracle.estimate import Estimate


@dataclass(frozen=True)
class Tick:
    """The data of one optimal control problem over N steps.

    Attributes
    ----------
    pose, state, slip
        (3,), (n,): the robot now.
    past, last_command
        (memory, 2) the commands on their way, oldest first, and (2,) the one that slew counts from.
    aim, heading
        (N + 1, 3) poses to be at, and (N + 1,) headings to have there [rad].
    feed_forward
        (N, 2) commands from which deviations are penalised.
    """

    pose: FloatArray
    state: FloatArray
    slip: Slip
    past: FloatArray
    last_command: FloatArray
    aim: FloatArray
    heading: FloatArray
    feed_forward: FloatArray


class FeedForward:
    """The command that would keep the reference's twist: the model's steady-state gain inverted, one lag ahead."""

    def __init__(self, model: VelocityModel, dt: float, steps: int) -> None:
        self.gain = model.dc_gain
        # A zero close to the origin can make a lag negative: there is no twist before now to answer to.
        self.ahead = np.maximum(model.lag, 0.0) / dt
        self.steps = steps
        self.samples = steps + int(np.floor(self.ahead.max())) + 1
        """Samples of the reference's twist that `commands` needs, from now on."""

    def commands(self, twist: FloatArray, slip: Slip) -> FloatArray:
        """(N, 2) commands for reference twists (samples, 2)."""
        at, samples = np.arange(self.steps), np.arange(len(twist))
        later = np.column_stack([np.interp(at + self.ahead[j], samples, twist[:, j]) for j in (0, 1)])
        return np.linalg.solve(self.gain, (later / slip.gains - slip.offset).T).T


def lean(poses: FloatArray, twist: FloatArray, side_slip: float, weights: Weights) -> tuple[FloatArray, FloatArray]:
    """What to aim at for reference `poses` (n, 3) with `twist` (n, 2): poses (n, 3) and headings (n,) [rad].

    To hold its path in a curve, a robot that side-slips must hold a heading error, the lead atan(side_slip omega).
    Where the heading error costs something too, part of it is made up for by a lag d along the path, where the tangent
    has turned less: along d^2 + heading (lead - curvature d)^2 is least at the d used here.
    """
    v, omega = twist.T
    lead = np.arctan(side_slip * omega)
    cost = weights.along * v**2 + weights.heading * omega**2
    share = np.where(cost > 0, weights.heading * lead * omega / np.where(cost > 0, cost, 1.0), 0.0)
    theta = poses[:, 2]
    aim = poses - (share * np.stack([v * np.cos(theta), v * np.sin(theta), omega])).T
    return aim, aim[:, 2] + lead


def begin_tick(
    feed_forward: FeedForward,
    weights: Weights,
    estimate: Estimate,
    past: FloatArray,
    last_command: FloatArray,
    sample: ReferenceSample,
) -> Tick:
    """The data of the problem, where `sample` is the reference now and at the ticks to come."""
    nodes = feed_forward.steps + 1
    poses = sample.pose[:nodes].copy()
    # The estimate counts its turns itself: meet it on the turn it is on.
    poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
    slip = estimate.slip
    aim, heading = lean(poses, sample.twist[:nodes], slip.side_slip, weights)
    commands = feed_forward.commands(sample.twist, slip)
    return Tick(estimate.pose, estimate.state, slip, past, last_command, aim, heading, commands)
