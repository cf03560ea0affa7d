"""Model-predictive path integral control: many random plans, averaged by how well they go.

Source: G. Williams, P. Drews, B. Goldfain, J. Rehg, E. Theodorou, "Information-theoretic model predictive control",
IEEE Transactions on Robotics 2018. The plan is the deviation from the reference's twist; each twist follows its command
with a first-order lag, the pose moves along it. Cost, smoothness and a plan that is shifted from tick to tick as users
of Nav2's MPPI know them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from diffdrive_mpc.bench.peers import TrackingLaw
from diffdrive_mpc.bench.peers.tracking_peer import AboveZero, Delayed, Gains, LawInput, NotNegative
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left

Floats32 = NDArray[np.float32]
SAMPLES, STEPS = 1000, 25
"""Number of ticks of the plans; docs/edge/edge.md has their computing times."""
_SEED = 0


class MppiGains(Gains):
    """Tuned gains; costs are relative to the temperature, which is 1."""

    position: AboveZero = Field(description="squared distance from the reference, each step [1/m^2]")
    across: NotNegative = Field(description="the same again for the part across the path [1/m^2]")
    heading: NotNegative = Field(description="squared heading error, each step [1/rad^2]")
    smoothness: NotNegative = Field(description="squared increment over the noise's deviation, each step [-]")
    v_noise: AboveZero = Field(description="standard deviation of v among the plans [m/s]")
    omega_noise: AboveZero = Field(description="standard deviation of omega among the plans [rad/s]")


class MppiLaw:
    """Seeded: the same measurements give the same commands."""

    gains = MppiGains

    def __init__(self, gains: MppiGains, robot: Delayed, samples: int = SAMPLES, steps: int = STEPS) -> None:
        self._gains, self._dt, self._samples, self._steps = gains, robot.sample_time, samples, steps
        self._noise = np.array([gains.v_noise, gains.omega_noise], dtype=np.float32)
        self._most = np.array([robot.limits.v, robot.limits.omega], dtype=np.float32)
        self._lag = robot.time_constant
        decay = np.exp(-robot.sample_time / robot.time_constant)
        ends = np.arange(steps + 1)
        since = ends[:, None] - 1 - ends[None, :-1]
        # Twist at the ends of all steps: the decayed first one, and the contribution of every command since.
        self._left = (decay[:, None] ** ends).astype(np.float32)
        response = (1 - decay)[:, None, None] * np.where(since >= 0, decay[:, None, None] ** np.maximum(since, 0), 0.0)
        self._response = response.transpose(0, 2, 1).astype(np.float32)

    def start(self, reference: Reference) -> None:
        """Start to track `reference`."""
        self._reference, self._random = reference, np.random.default_rng(_SEED)
        self._plan = np.zeros((2, self._steps), dtype=np.float32)

    def decide(self, sight: LawInput) -> FloatArray:
        """Compute the wanted v [m/s] and omega [rad/s] (2,)."""
        dt = self._dt
        ahead = self._reference.sample(sight.time + dt * np.arange(1, self._steps + 1))
        wanted = self._feed_forward(sight)
        noise = self._random.standard_normal((2, self._samples, self._steps), dtype=np.float32)
        noise *= self._noise[:, None, None]
        noise[:, 0] = 0.0
        most = self._most[:, None, None]
        commands = np.clip((wanted + self._plan)[:, None] + noise, -most, most)
        cost = self._cost(sight, ahead.pose, commands, wanted)
        weights = np.exp(cost.min() - cost)
        weights /= weights.sum()
        best = np.einsum("s,csk->ck", weights, commands)
        self._plan = np.column_stack([(best - wanted)[:, 1:], np.zeros(2, dtype=np.float32)])
        return np.asarray(best[:, 0], dtype=float)

    def _feed_forward(self, sight: LawInput) -> Floats32:
        """Compute commands (2, N) without a deviation: the reference's twist, one lag ahead."""
        times = sight.time + self._dt * np.arange(self._steps)
        later = self._reference.sample(np.concatenate([times + lag for lag in self._lag])).twist
        wanted = np.stack([later[: self._steps, 0], later[self._steps :, 1]]).astype(np.float32)
        wanted[:, 0] = sight.feed_forward
        return wanted

    def _cost(self, sight: LawInput, reference: FloatArray, commands: Floats32, wanted: Floats32) -> Floats32:
        """Compute the cost (S,) of each plan."""
        gains, dt = self._gains, np.float32(self._dt)
        first = sight.motion.twist.astype(np.float32)
        twist = commands @ self._response + (first[:, None] * self._left)[:, None]
        v, omega = 0.5 * (twist[:, :, 1:] + twist[:, :, :-1])
        turned = np.cumsum(omega * dt, axis=1)
        # In the robot's frame of now, in which single precision is plenty.
        middle = turned - 0.5 * dt * omega
        x, y = np.cumsum(v * np.cos(middle) * dt, axis=1), np.cumsum(v * np.sin(middle) * dt, axis=1)
        present, heading = sight.motion.pose, sight.motion.pose[2]
        goal_x, goal_y = (
            offset.astype(np.float32) for offset in ahead_and_left(reference[:, :2] - present[:2], heading)
        )
        unwrapped = reference[:, 2] + 2 * np.pi * np.round((sight.reference[2] - reference[0, 2]) / (2 * np.pi))
        goal = (unwrapped - heading).astype(np.float32)
        dx, dy = x - goal_x, y - goal_y
        across = dy * np.cos(goal) - dx * np.sin(goal)
        pose = gains.position * (dx * dx + dy * dy) + gains.across * across * across
        pose += gains.heading * (turned - goal) ** 2
        deviation = (commands - wanted[:, None]) / self._noise[:, None, None]
        steps = np.diff(deviation, axis=2)
        cost = pose.sum(axis=1) + gains.smoothness * (steps * steps).sum(axis=(0, 2))
        beside = self._beside(sight, x, y, turned)
        return np.asarray(cost if beside is None else cost + beside, dtype=np.float32)

    def _beside(self, sight: LawInput, x: Floats32, y: Floats32, turned: Floats32) -> Floats32 | None:
        """Compute the additional cost (S,) of a plan by its poses (S, N) in the present frame of the robot, if any."""
        del sight, x, y, turned
        return None


MPPI = TrackingLaw(MppiLaw, Path(__file__).with_name("gains.yaml"))
