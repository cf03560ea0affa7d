"""Data of the problem of a tick: state of the robot, target, and feed-forward commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.estimate import Estimate


@dataclass(frozen=True)
class Tick:
    """Data of one optimal control problem over N steps.

    Attributes
    ----------
    pose, state, slip
        Current pose (3,), states (n,) and slip of the robot.
    past, last_command
        Delayed commands (memory, 2), oldest first, and the command (2,) to which the slew limit refers.
    aim, heading
        Target poses (N + 1, 3), and target headings (N + 1,) [rad].
    feed_forward, fed_before
        Feed-forward commands (N, 2), from which deviations are penalised, and the command of the last tick (2,).
    late
        Delay (2,) of the commands in addition to the delay of the model [samples].
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
    """Feed-forward command for the reference twist: inverse of the model's steady-state gain, one lag ahead."""

    def __init__(self, model: VelocityModel, dt: float, steps: int, spare: int) -> None:
        self.gain, self.dt = model.dc_gain, dt
        # A zero close to the origin can make a lag negative; twists of the past are not used.
        self.ahead = np.maximum(model.lag, 0.0) / dt
        self.steps = steps
        self.samples = steps + int(np.floor(self.ahead.max())) + 1 + spare
        """Number of samples of the reference twist for `commands`, starting at the current tick."""

    def commands(self, twist: FloatArray, slip: Slip, late: FloatArray) -> FloatArray:
        """Compute commands (N + 1, 2) for reference twists (samples, 2), from the last tick on."""
        instants, samples, ahead = np.arange(-1, self.steps), np.arange(len(twist)), self.ahead + late
        shifted = np.column_stack([np.interp(instants + ahead[j], samples, twist[:, j]) for j in (0, 1)])
        # Convert to the speed of the turning point.
        shifted[:, 0] -= slip.turn_left * shifted[:, 1]
        return np.linalg.solve(self.gain, (shifted / slip.gains - slip.offset).T).T


def target_heading(poses: FloatArray, twist: FloatArray, acceleration: FloatArray, slip: Slip) -> FloatArray:
    """Compute headings (n,) [rad] at which a robot travels along reference `poses` (n, 3) with `twist` (n, 2).

    `acceleration` (n,) [m/s^2] is the forward acceleration.

    With a lateral speed u to the left, the robot travels at atan(u / v) to the left of its heading, so its heading must
    be to the right by this angle. Two parts of u / v grow as v vanishes, -turn_ahead omega / v and the slide. Below
    0.1 m/s they use a bounded function instead of 1 / v, because a robot cannot compensate them in a turn on the spot.
    """
    v, omega = twist.T
    share = v / (v * v + 0.01)
    lateral_slide = np.column_stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])]) @ [slip.slide_x, slip.slide_y]
    slide = (np.sqrt(omega**2 + 0.05**2) - 0.05) * lateral_slide
    ahead = slip.turn_ahead - slip.load_shift * acceleration
    return poses[:, 2] - np.arctan(-omega * slip.side_slip + (slide - omega * ahead) * share)


def begin_tick(
    feed_forward: FeedForward, estimate: Estimate, past: FloatArray, last_command: FloatArray, sample: ReferenceSample
) -> Tick:
    """Build the data of the problem; `sample` contains the reference at the current and the following ticks."""
    nodes = feed_forward.steps + 1
    poses = sample.pose[:nodes].copy()
    # The heading of the estimate is unwrapped; the reference is shifted to the same full turn.
    poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
    slip = estimate.slip
    growth = np.diff(sample.twist[:, 0]) / feed_forward.dt
    heading = target_heading(poses, sample.twist[:nodes], np.append(growth, growth[-1])[:nodes], slip)
    # Delays are rounded to whole milliseconds.
    late = np.round(1e3 * estimate.delays) / 1e3 / feed_forward.dt
    last_feed_forward, *commands = feed_forward.commands(sample.twist, slip, late)
    data = (estimate.pose, estimate.state, slip, past, last_command, poses, heading)
    return Tick(*data, np.array(commands), last_feed_forward, late)
