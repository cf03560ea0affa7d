"""Open-loop odometry: the pose that a model predicts from commands alone, and its error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.discrete_model import DiscreteModel, zero_order_hold
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.linear_system import LinearSystem
from diffdrive_mpc.models.pose import integrate_pose


@dataclass(frozen=True)
class Spread:
    """Statistics of the size of an error over a run, as the papers print them."""

    rmse: float
    mean: float
    std: float
    max: float

    @classmethod
    def of(cls, error: ArrayLike) -> Spread:
        """Of errors (K,) of any sign."""
        size = np.abs(np.asarray(error, dtype=float))
        return cls(
            float(np.sqrt(np.mean(size**2))),
            float(np.mean(size)),
            float(np.std(size)),
            float(np.max(size, initial=0.0)),
        )


@dataclass(frozen=True)
class PoseError:
    """Errors of a predicted path against the driven one, at the same times.

    Attributes
    ----------
    position
        Distance [m].
    heading
        Difference of the unwrapped headings [rad].
    """

    position: Spread
    heading: Spread


def dead_reckon(twist: FloatArray, start: ArrayLike, dt: float) -> FloatArray:
    """Poses (K, 3) that a twist (K, 2) v [m/s], omega [rad/s] leads through from `start` (3,).

    Exact arcs of the mean twist between two samples, without side-slip (Guffanti et al., Sensors 2025, 25(11), 3553).
    """
    start = np.asarray(start, dtype=float)
    v, omega = (0.5 * (twist[1:] + twist[:-1])).T
    theta = start[2] + np.concatenate([[0.0], np.cumsum(omega * dt)])
    there = np.column_stack([np.zeros((len(v), 2)), theta[:-1]])
    legs = integrate_pose(there, v, omega, dt)[:, :2]
    return np.column_stack([np.vstack([start[:2], start[:2] + np.cumsum(legs, axis=0)]), theta])


def sampled(system: LinearSystem, dt: float) -> DiscreteModel:
    """An identified system without its sensor offsets, sampled with `dt` [s].

    It need not be a robot's: an identification may place a pole that the data do not determine further out than
    `VelocityModel` accepts.
    """
    return zero_order_hold(system.A, system.B, system.C, system.dead_time, dt)


def predict_path(model: DiscreteModel, commands: FloatArray, start: ArrayLike) -> FloatArray:
    """Poses (K, 3) from commands (K, 2) alone, from rest at `start` (3,)."""
    return dead_reckon(model.simulate(commands), start, model.dt)


def pose_error(predicted: FloatArray, driven: FloatArray) -> PoseError:
    """Statistics of predicted poses (K, 3) against driven ones (K, 3), headings unwrapped."""
    error = predicted - driven
    return PoseError(Spread.of(np.hypot(error[:, 0], error[:, 1])), Spread.of(error[:, 2]))
