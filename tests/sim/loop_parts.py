"""Small plants, controllers and references with known results, for tests of the loop and its metrics."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, ReferenceSample, Stamped
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.run import Run
from studies.open_loop import random_commands


@dataclass(frozen=True)
class ConstantTwist:
    """Reference with constant twist: a line, a circle, a turn on the spot, forwards or backwards."""

    v: float
    omega: float
    duration: float
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = "constant twist"

    def sample(self, times: ArrayLike) -> ReferenceSample:
        times = np.asarray(times, dtype=float)
        clipped = np.clip(times, 0.0, self.duration)
        is_moving = ((times >= 0) & (times <= self.duration)).astype(float)
        pose = integrate_pose(self.start, self.v * clipped, self.omega * clipped, 1.0)
        return ReferenceSample(pose, np.outer(is_moving, [self.v, self.omega]), np.abs(self.v) * clipped)


@dataclass(frozen=True)
class ElbowReference:
    """Reference of 1 m ahead, a left turn on the spot, and 1 m ahead; each part takes one second."""

    duration: float = 3.0
    name: str = "elbow"

    def sample(self, times: ArrayLike) -> ReferenceSample:
        t = np.clip(np.asarray(times, dtype=float), 0.0, 3.0)
        first, turn, second = np.clip(t, 0, 1), np.clip(t - 1, 0, 1), np.clip(t - 2, 0, 1)
        straight = ((t < 1) | (t > 2)).astype(float)
        pose = np.column_stack([first, second, turn * np.pi / 2])
        return ReferenceSample(pose, np.column_stack([straight, (1 - straight) * np.pi / 2]), first + second)


class KinematicPlant:
    """Unicycle that follows commands immediately, with exact sensors and Gaussian pose noise from a seed."""

    sample_time = 0.02

    def __init__(self, noise: float = 0.0, seed: int = 0) -> None:
        self._noise, self._seed = noise, seed
        self.reset([0.0, 0.0, 0.0])

    def reset(self, pose: ArrayLike) -> None:
        self._rng = np.random.default_rng(self._seed)
        self.true_pose: FloatArray = np.array(pose, dtype=float)
        self.true_twist: FloatArray = np.zeros(3)
        self.time = 0.0

    def measure(self) -> Measurement:
        v, _, omega = self.true_twist
        return Measurement(
            pose=Stamped(self.true_pose + self._noise * self._rng.standard_normal(3), self.time),
            wheel_twist=Stamped(np.array([v, omega]), self.time),
            yaw_rate=Stamped(omega, self.time),
        )

    def advance(self, command: ArrayLike) -> None:
        v, omega = np.asarray(command, dtype=float)
        self.true_pose = integrate_pose(self.true_pose, v, omega, self.sample_time)
        self.true_twist = np.array([v, 0.0, omega])
        self.time += self.sample_time


@dataclass(frozen=True)
class FixedStep:
    command: FloatArray
    mode: str = "TRACKING"
    message: str = ""
    solver: None = None
    plan: None = None
    step_time: float = 1e-3
    solve_time: float = float("nan")


class FeedForward:
    """Controller that sends the twist of the reference; `mode_at` sets other modes at some ticks."""

    def __init__(self, mode_at: dict[int, str] | None = None) -> None:
        self._mode_at = mode_at or {}

    def start(self, reference: Reference, t0: float) -> None:
        self._reference, self._t0, self._tick = reference, t0, 0

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        mode = self._mode_at.get(self._tick, "TRACKING")
        self._tick += 1
        return FixedStep(self._reference.sample([t - self._t0]).twist[0], mode)


class SlowController(FeedForward):
    """Controller that reports long step times."""

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        return FixedStep(super().step(t, measurement).command, step_time=0.03)


def trace(plant: Plant, ticks: int) -> list[Any]:
    """Record all observable data of a drive of `ticks` ticks, in comparable form."""
    rows: list[Any] = []
    for command in random_commands(4, duration=(ticks + 1) * plant.sample_time)[:ticks]:
        measured = plant.measure()
        stamped = (measured.pose, measured.wheel_twist, measured.yaw_rate, measured.wheel_speeds)
        rows.append(
            [None if reading is None else (np.asarray(reading.value).tolist(), reading.time) for reading in stamped]
        )
        rows.append((measured.sent, plant.time, plant.true_pose.tolist(), plant.true_twist.tolist()))
        plant.advance(command)
    return rows


def run_along(
    reference: Reference,
    true_pose: ArrayLike,
    true_twist: ArrayLike,
    times: ArrayLike,
    modes: tuple[str, ...] | None = None,
) -> Run:
    """Build a run with the given true motion, without measurements."""
    times = np.asarray(times, dtype=float)
    expected = reference.sample(times)
    n = len(times)
    return Run(
        reference=reference,
        sample_time=float(times[1] - times[0]),
        time=times,
        true_pose=np.broadcast_to(np.asarray(true_pose, dtype=float), (n, 3)),
        true_twist=np.broadcast_to(np.asarray(true_twist, dtype=float), (n, 3)),
        reference_pose=expected.pose,
        reference_twist=expected.twist,
        reference_arc_length=expected.arc_length,
        command=expected.twist,
        step_time=np.full(n, 1e-3),
        modes=modes or ("TRACKING",) * n,
        messages=("",) * n,
        measurements=(Measurement(),) * n,
    )
