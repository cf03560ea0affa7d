"""Data of one tick's problem: the robot's state, its target, and the feed-forward commands."""

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
        Present pose (3,), states (n,) and slip of the robot.
    past, last_command
        Delayed commands (memory, 2), oldest first, and the command (2,) from which slew counts.
    aim, heading
        Target poses (N + 1, 3), and target headings (N + 1,) [rad].
    feed_forward, fed_before
        Commands (N, 2) from which deviations are penalised, and that of the last tick (2,).
    late
        Delay (2,) of the commands beyond that of the model [samples].
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
    """Command that keeps the reference's twist: the model's steady-state gain inverted, one lag ahead."""

    def __init__(self, model: VelocityModel, dt: float, steps: int, spare: int) -> None:
        self.gain, self.dt = model.dc_gain, dt
        # A zero close to the origin can make a lag negative; twists of the past are not used.
        self.ahead = np.maximum(model.lag, 0.0) / dt
        self.steps = steps
        self.samples = steps + int(np.floor(self.ahead.max())) + 1 + spare
        """Samples of the reference's twist that `commands` needs, from now on."""

    def commands(self, twist: FloatArray, slip: Slip, late: FloatArray) -> FloatArray:
        """Compute commands (N + 1, 2) for reference twists (samples, 2), from the last tick on."""
        instants, samples, ahead = np.arange(-1, self.steps), np.arange(len(twist)), self.ahead + late
        later = np.column_stack([np.interp(instants + ahead[j], samples, twist[:, j]) for j in (0, 1)])
        # Convert to the speed of the turning point.
        later[:, 0] -= slip.turn_left * later[:, 1]
        return np.linalg.solve(self.gain, (later / slip.gains - slip.offset).T).T


def target_heading(poses: FloatArray, twist: FloatArray, acceleration: FloatArray, slip: Slip) -> FloatArray:
    """Compute headings (n,) [rad] at which a robot travels along reference `poses` (n, 3) with `twist` (n, 2).

    `acceleration` (n,) [m/s^2] is the forward acceleration.

    With a speed u to the left of v, the robot travels at atan(u / v) to the left of its heading, so it has to point as
    far to the right. Two parts of u / v grow as v vanishes, -turn_ahead omega / v and the slide: instead of 1 / v they
    use a bounded function below 0.1 m/s, since a robot that turns on the spot cannot compensate them.
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
    """Build the data of the problem; `sample` is the reference now and at the following ticks."""
    nodes = feed_forward.steps + 1
    poses = sample.pose[:nodes].copy()
    # Heading of the estimate is unwrapped: move the reference to the same turn.
    poses[:, 2] += 2 * np.pi * np.round((estimate.pose[2] - poses[0, 2]) / (2 * np.pi))
    slip = estimate.slip
    growth = np.diff(sample.twist[:, 0]) / feed_forward.dt
    heading = target_heading(poses, sample.twist[:nodes], np.append(growth, growth[-1])[:nodes], slip)
    # Delays are rounded to whole milliseconds.
    late = np.round(1e3 * estimate.delays) / 1e3 / feed_forward.dt
    before, *commands = feed_forward.commands(sample.twist, slip, late)
    data = (estimate.pose, estimate.state, slip, past, last_command, poses, heading)
    return Tick(*data, np.array(commands), before, late)
