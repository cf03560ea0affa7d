"""Records of drives of the simulated robot, and poses that a model predicts from commands without measurements."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.discrete_model import DiscreteModel, zero_order_hold
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.output_error.state_space import LinearSystem
from diffdrive_mpc.models.pose import integrate_pose
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.trajectories import load_segments
from diffdrive_mpc.sim import make_plant
from studies.open_loop import drive_open_loop, load_command_parameters, random_commands, step_commands
from studies.reproduce.published import PaperRange

StepKind = Literal["wheels", "v", "omega"]
STEP_KINDS: tuple[StepKind, ...] = ("wheels", "v", "omega")
STATISTICS = {"RMSE": "rmse", "mean": "mean", "standard deviation": "std", "max": "max"}
"""Fields of `Spread` by name of the statistic in the papers, in the order of their tables."""
QUANTITIES = {"position": "m", "heading": "rad"}
"""Units of the two parts of a pose error."""
_SEEDS_PER_REPETITION = 1000


@dataclass(frozen=True)
class Spread:
    """Statistics of an absolute error over a run, as in the papers."""

    rmse: float
    mean: float
    std: float
    max: float

    @classmethod
    def of_errors(cls, error: ArrayLike) -> Spread:
        """Compute the spread of signed errors (K,)."""
        magnitude = np.abs(np.asarray(error, dtype=float))
        return cls(
            float(np.sqrt(np.mean(magnitude**2))),
            float(np.mean(magnitude)),
            float(np.std(magnitude)),
            float(np.max(magnitude, initial=0.0)),
        )

    @property
    def statistics(self) -> list[float]:
        """Values in the order of `STATISTICS`."""
        return [getattr(self, field) for field in STATISTICS.values()]


@dataclass(frozen=True)
class PathError:
    """Error statistics of predicted poses, relative to the true poses at the same times.

    Attributes
    ----------
    position
        Statistics of the distance [m].
    heading
        Statistics of the difference of the unwrapped headings [rad].
    """

    position: Spread
    heading: Spread


def dead_reckon(twist: FloatArray, start: ArrayLike, dt: float) -> FloatArray:
    """Integrate twists (K, 2) of v [m/s] and omega [rad/s] to poses (K, 3) from `start` (3,).

    Between two samples, the path is the arc of the mean of both twists, without side-slip (Guffanti et al., Sensors
    2025, 25(11), 3553).
    """
    start = np.asarray(start, dtype=float)
    v, omega = (0.5 * (twist[1:] + twist[:-1])).T
    theta = start[2] + np.concatenate([[0.0], np.cumsum(omega * dt)])
    start_poses = np.column_stack([np.zeros((len(v), 2)), theta[:-1]])
    displacements = integrate_pose(start_poses, v, omega, dt)[:, :2]
    return np.column_stack([np.vstack([start[:2], start[:2] + np.cumsum(displacements, axis=0)]), theta])


def discretise(system: LinearSystem, dt: float) -> DiscreteModel:
    """Discretise an identified system without its sensor offsets, with sample time `dt` [s].

    Unlike `VelocityModel`, this function accepts every pole, because an identification may return a very fast pole if
    the data do not determine it.
    """
    return zero_order_hold(system.A, system.B, system.C, system.dead_time, dt)


def predict_path(model: DiscreteModel | NonlinearModel, commands: FloatArray, start: ArrayLike) -> FloatArray:
    """Predict poses (K, 3) from commands (K, 2) without measurements, from rest at `start` (3,)."""
    return dead_reckon(model.simulate(commands), start, model.dt)


def pose_error(predicted: FloatArray, driven: FloatArray) -> PathError:
    """Compute error statistics of predicted poses (K, 3) relative to driven poses (K, 3), with unwrapped headings."""
    error = predicted - driven
    return PathError(Spread.of_errors(np.hypot(error[:, 0], error[:, 1])), Spread.of_errors(error[:, 2]))


class RobotLogs:
    """Source of the drives of one repetition; each drive uses the next seed.

    The records contain true poses, whereas the papers compare predictions with a localisation, whose error is small
    compared with the prediction error.

    Parameters
    ----------
    repetition
        Number of the repetition, which determines the seeds.
    """

    def __init__(self, repetition: int) -> None:
        self._seeds: Iterator[int] = iter(
            range(_SEEDS_PER_REPETITION * repetition, _SEEDS_PER_REPETITION * (repetition + 1))
        )

    def steps(self, kind: StepKind) -> list[Record]:
        """Record the steps of "wheels", "v" or "omega"; see `studies.open_loop.step_commands`."""
        return self._record_drives(f"step of {kind}", step_commands(kind))

    def free(self, drives: int, duration: float, maximum: PaperRange | None = None) -> list[Record]:
        """Record drives of `duration` [s] with smoothed random set-points, which are scaled to `maximum` if given."""
        ranges = load_command_parameters().random
        upper_ends = np.array([ranges.v_range[1], ranges.omega_range[1]])
        scale = np.array([maximum.v, maximum.omega]) / upper_ends if maximum else np.ones(2)
        return [
            record_drive(f"free drive, seed {seed}", seed, scale * random_commands(seed, duration=duration))
            for seed in (next(self._seeds) for _ in range(drives))
        ]

    def trajectory(self, name: str) -> Record:
        """Record a trajectory's commands in open loop, from rest at the origin."""
        return self._record_drives(name, [trajectory_commands(name)])[0]

    def _record_drives(self, name: str, commands: Iterable[FloatArray]) -> list[Record]:
        return [record_drive(name, next(self._seeds), rows) for rows in commands]


def trajectory_commands(name: str) -> FloatArray:
    """Sample the twists (K, 2) of a trajectory's segments, v [m/s] and omega [rad/s], without ramps between them."""
    segments, dt = load_segments(name), load_robot().sample_time
    end_times = np.cumsum([segment.duration for segment in segments])
    rows = np.searchsorted(end_times, dt * np.arange(round(end_times[-1] / dt)), side="right")
    return np.array([(segment.v, segment.omega) for segment in segments])[np.minimum(rows, len(segments) - 1)]


def record_drive(name: str, seed: int, commands: FloatArray) -> Record:
    """Drive the simulated robot in open loop on the default surface and record the drive."""
    log = drive_open_loop(make_plant("mujoco", seed=seed), commands)
    return Record(
        name,
        0.0,
        load_robot().sample_time,
        log.command,
        twist=log.wheel_twist,
        yaw_rate=log.yaw_rate,
        pose=log.true_pose,
        wheel_speeds=log.wheel_speeds,
    )
