"""Model-predictive path integral control (MPPI): average of random plans, weighted by their costs.

Source: G. Williams, P. Drews, B. Goldfain, J. Rehg, E. Theodorou, "Information-theoretic model predictive control",
IEEE Transactions on Robotics 2018. The plan is the deviation from the reference twist. The twist follows the commands
with a first-order lag, and is integrated to poses. As in Nav2's MPPI, the cost has a smoothness term, and the plan is
shifted at each tick.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from diffdrive_mpc.bench.peers import TrackingLaw
from diffdrive_mpc.bench.peers.tracking_peer import AboveZero, Gains, LawInput, NotNegative, RobotParameters
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

Floats32 = NDArray[np.float32]
SAMPLES, STEPS = 1000, 25
"""Number of sampled plans and number of ticks of a plan; docs/edge/edge.md has the computing times."""
_SEED = 0


class MppiGains(Gains):
    """Tuned gains; costs are relative to the temperature, which is 1."""

    position: AboveZero = Field(description="weight of the squared position error in each step [1/m^2]")
    across: NotNegative = Field(description="additional weight of the squared lateral error in each step [1/m^2]")
    heading: NotNegative = Field(description="weight of the squared heading error in each step [1/rad^2]")
    smoothness: NotNegative = Field(description="weight of squared command increments, normalised by the noise [-]")
    v_noise: AboveZero = Field(description="standard deviation of v among the plans [m/s]")
    omega_noise: AboveZero = Field(description="standard deviation of omega among the plans [rad/s]")


class MppiLaw:
    """MPPI law with a constant seed: the same measurements give the same commands."""

    gains = MppiGains

    def __init__(self, gains: MppiGains, robot: RobotParameters, samples: int = SAMPLES, steps: int = STEPS) -> None:
        self._gains, self._dt, self._samples, self._steps = gains, robot.sample_time, samples, steps
        self._noise = np.array([gains.v_noise, gains.omega_noise], dtype=np.float32)
        self._limits = np.array([robot.limits.v, robot.limits.omega], dtype=np.float32)
        self._lag = robot.time_constant
        decay = np.exp(-robot.sample_time / robot.time_constant)
        ends = np.arange(steps + 1)
        age = ends[:, None] - 1 - ends[None, :-1]
        # The twist at the end of a step is the decayed initial twist plus the contributions of all previous commands.
        self._initial_response = (decay[:, None] ** ends).astype(np.float32)
        response = (1 - decay)[:, None, None] * np.where(age >= 0, decay[:, None, None] ** np.maximum(age, 0), 0.0)
        self._response = response.transpose(0, 2, 1).astype(np.float32)

    def start(self, reference: Reference) -> None:
        """Start tracking `reference`."""
        self._reference, self._random = reference, np.random.default_rng(_SEED)
        self._plan = np.zeros((2, self._steps), dtype=np.float32)

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the desired v [m/s] and omega [rad/s] (2,)."""
        dt = self._dt
        reference = self._reference.sample(sight.time + dt * np.arange(1, self._steps + 1))
        feed_forward = self._feed_forward(sight)
        noise = self._random.standard_normal((2, self._samples, self._steps), dtype=np.float32)
        noise *= self._noise[:, None, None]
        noise[:, 0] = 0.0
        limits = self._limits[:, None, None]
        commands = np.clip((feed_forward + self._plan)[:, None] + noise, -limits, limits)
        cost = self._cost(sight, reference.pose, commands, feed_forward)
        weights = np.exp(cost.min() - cost)
        weights /= weights.sum()
        mean = np.einsum("s,csk->ck", weights, commands)
        self._plan = np.column_stack([(mean - feed_forward)[:, 1:], np.zeros(2, dtype=np.float32)])
        return np.asarray(mean[:, 0], dtype=float)

    def _feed_forward(self, sight: LawInput) -> Floats32:
        """Compute the feed-forward commands (2, N): the reference twist, advanced by the lags."""
        times = sight.time + self._dt * np.arange(self._steps)
        twist = self._reference.sample(np.concatenate([times + lag for lag in self._lag])).twist
        feed_forward = np.stack([twist[: self._steps, 0], twist[self._steps :, 1]]).astype(np.float32)
        feed_forward[:, 0] = sight.feed_forward
        return feed_forward

    def _cost(self, sight: LawInput, reference: FloatArray, commands: Floats32, feed_forward: Floats32) -> Floats32:
        """Compute the cost (S,) of the plans."""
        gains, dt = self._gains, np.float32(self._dt)
        initial = sight.motion.twist.astype(np.float32)
        twist = commands @ self._response + (initial[:, None] * self._initial_response)[:, None]
        v, omega = 0.5 * (twist[:, :, 1:] + twist[:, :, :-1])
        rotation = np.cumsum(omega * dt, axis=1)
        # Poses relative to the current pose; single precision is sufficient in this frame.
        middle = rotation - 0.5 * dt * omega
        x, y = np.cumsum(v * np.cos(middle) * dt, axis=1), np.cumsum(v * np.sin(middle) * dt, axis=1)
        position, heading = sight.motion.pose[:2], sight.motion.pose[2]
        goal_x, goal_y = (offset.astype(np.float32) for offset in ahead_and_left(reference[:, :2] - position, heading))
        unwrapped = reference[:, 2] + 2 * np.pi * np.round((sight.reference[2] - reference[0, 2]) / (2 * np.pi))
        goal = (unwrapped - heading).astype(np.float32)
        dx, dy = x - goal_x, y - goal_y
        across = dy * np.cos(goal) - dx * np.sin(goal)
        pose_cost = gains.position * (dx * dx + dy * dy) + gains.across * across * across
        pose_cost += gains.heading * (rotation - goal) ** 2
        deviation = (commands - feed_forward[:, None]) / self._noise[:, None, None]
        increments = np.diff(deviation, axis=2)
        cost = pose_cost.sum(axis=1) + gains.smoothness * (increments * increments).sum(axis=(0, 2))
        additional = self._additional_cost(sight, x, y, rotation)
        return np.asarray(cost if additional is None else cost + additional, dtype=np.float32)

    def _additional_cost(self, sight: LawInput, x: Floats32, y: Floats32, rotation: Floats32) -> Floats32 | None:
        """Compute an additional cost (S,) from poses (S, N) relative to the current pose; None if there is no cost."""
        del sight, x, y, rotation
        return None


MPPI = TrackingLaw(MppiLaw, Path(__file__).with_name("gains.yaml"))
