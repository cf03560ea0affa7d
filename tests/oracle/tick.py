"""Data of one tick's problem: the robot's state, its target, and the commands that would hold it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.problem.slip import Slip
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
    feed_forward, fed_before
        (N, 2) commands from which deviations are penalised, and (2,) that of the last tick.
    late
        (2,) by which commands act later than the model says [samples].
    """

    pose: FloatArray
    state: FloatArray
    slip: Slip
    past: FloatArray
    last_command: FloatArray
    aim: FloatArray
    heading: FloatArray
    feed_forward: FloatArray
    fed_before: FloatArray
    late: FloatArray


class FeedForward:
    """The command that would keep the reference's twist: the model's steady-state gain inverted, one lag ahead."""

    def __init__(self, model: VelocityModel, dt: float, steps: int, spare: int) -> None:
        self.gain, self.dt = model.dc_gain, dt
        # A zero close to the origin can make a lag negative: there is no twist before now to answer to.
        self.ahead = np.maximum(model.lag, 0.0) / dt
        self.steps = steps
        self.samples = steps + int(np.floor(self.ahead.max())) + 1 + spare
        """Samples of the reference's twist that `commands` needs, from now on."""

    def commands(self, twist: FloatArray, slip: Slip, late: FloatArray) -> FloatArray:
        """Compute (N + 1, 2) commands for reference twists (samples, 2), from the last tick on."""
        instants, samples, ahead = np.arange(-1, self.steps), np.arange(len(twist)), self.ahead + late
        later = np.column_stack([np.interp(instants + ahead[j], samples, twist[:, j]) for j in (0, 1)])
        # Of the point about which the robot turns.
        later[:, 0] -= slip.turn_left * later[:, 1]
        return np.linalg.solve(self.gain, (later / slip.gains - slip.offset).T).T


def heading_to_hold(poses: FloatArray, twist: FloatArray, acceleration: FloatArray, slip: Slip) -> FloatArray:
    """Compute (n,) headings [rad] at which a robot travels along reference `poses` (n, 3) with `twist` (n, 2).

    `acceleration` (n,) [m/s^2] is the forward one.

    At a speed u to the left of v it travels atan(u / v) to the left of its heading, so it has to point as far to the
    right. Two parts of u / v grow as v fades, -turn_ahead omega / v and the slide; instead of 1 / v they are made to
    bend off below 0.1 m/s, since a robot that turns on the spot cannot make up for them.
    """
    v, omega = twist.T
    share = v / (v * v + 0.01)
    left = np.column_stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])]) @ [slip.slide_x, slip.slide_y]
    slide = (np.sqrt(omega**2 + 0.05**2) - 0.05) * left
    ahead = slip.turn_ahead - slip.load_shift * acceleration
    return poses[:, 2] - np.arctan(-omega * slip.side_slip + (slide - omega * ahead) * share)


def begin_tick(
    feed_forward: FeedForward, estimate: Estimate, past: FloatArray, last_command: FloatArray, sample: ReferenceSample
) -> Tick:
    """Build the data of the problem, where `sample` is the reference now and at the ticks to come."""
    nodes = feed_forward.steps + 1
    poses = sample.pose[:nodes].copy()
    # The estimate counts its turns itself: meet it on the turn it is on.
    poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
    slip = estimate.slip
    growth = np.diff(sample.twist[:, 0]) / feed_forward.dt
    heading = heading_to_hold(poses, sample.twist[:nodes], np.append(growth, growth[-1])[:nodes], slip)
    # In whole milliseconds.
    late = np.round(1e3 * estimate.delays) / 1e3 / feed_forward.dt
    before, *commands = feed_forward.commands(sample.twist, slip, late)
    data = (estimate.pose, estimate.state, slip, past, last_command, poses, heading)
    return Tick(*data, np.array(commands), before, late)
