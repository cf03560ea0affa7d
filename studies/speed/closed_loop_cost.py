"""What a whole drive cost by the controller's own weights: one figure to compare controllers of the same problem."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.formulas import formula
from diffdrive_mpc.mpc.problem.slip import Slip


def closed_loop_cost(
    pose: FloatArray,
    twist: FloatArray,
    command: FloatArray,
    reference: Reference,
    config: ControllerConfig,
    model: VelocityModel,
) -> float:
    """Mean over the ticks of the stage cost of `mpc.problem`, taken where the robot really was.

    Half the weighted sum of squares of the pose error along and across the reference and in heading, of the command's
    deviation from its feed-forward and of its increments, plus the penalties on soft limits that were exceeded. The
    terminal weight has no part in it, nor has slip: the feed-forward is that of the model, and no lead is asked for.

    Parameters
    ----------
    pose
        (n, 3) true pose at each tick, the first at time 0 of the reference: x [m], y [m], theta [rad].
    twist
        (n, 2) true v [m/s], omega [rad/s] at each tick.
    command
        (n, 2) v_ref [m/s], omega_ref [rad/s] sent at each tick; before the first the robot stood.
    reference
        What was to be tracked.
    config
        Weights, limits, track and sample time.
    model
        The velocity model whose steady gain the feed-forward inverts.

    Returns
    -------
    float
        Cost per tick [-].

    Raises
    ------
    ValueError
        If the shapes do not agree, or a value is not finite.
    """
    n = len(command)
    if pose.shape != (n, 3) or twist.shape != (n, 2) or command.shape != (n, 2):
        raise ValueError(
            f"pose {pose.shape}, twist {twist.shape}, command {command.shape}: give (n, 3), (n, 2), (n, 2)"
        )
    if not all(np.isfinite(values).all() for values in (pose, twist, command)):
        raise ValueError("pose, twist and command must be finite: a drive that failed has no cost")
    ahead = FeedForward.of(model, config.sample_time)
    sample = reference.sample(config.sample_time * np.arange(n + int(ahead.whole.max()) + 1))
    w = config.weights
    in_path = _in_path(pose, sample.pose[:n])
    deviation = command - _fed_forward(ahead, sample.twist, n)
    increment = np.diff(command, axis=0, prepend=np.zeros((1, 2)))
    squares = in_path**2 @ [w.along, w.across, w.heading]
    squares += deviation**2 @ [w.v, w.omega] + increment**2 @ [w.v_increment, w.omega_increment]
    excess = np.maximum(_soft_values(twist, in_path[:, 1], config) - _soft_limits(config), 0.0)
    penalty = w.soft * excess.sum(axis=1) + w.soft_quadratic * (excess**2).sum(axis=1) / 2
    return float(np.mean(squares / 2 + penalty))


def _fed_forward(ahead: FeedForward, twist: FloatArray, n: int) -> FloatArray:
    """(n, 2) commands that would keep the reference's twist, without slip."""
    rows = np.arange(n)[:, None] + ahead.whole
    now, after = twist[rows, [0, 1]], twist[rows + 1, [0, 1]]
    wanted = (now + ahead.rest * (after - now)).T
    return np.asarray(formula("feed_forward").map(n)(wanted, Slip().flat, ahead.inverse_gain)).T


def _in_path(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """(n, 3) errors along, across and in heading."""
    error = pose - reference
    return np.column_stack([*ahead_and_left(error, reference[:, 2]), wrap_angle(error[:, 2])])


def _soft_values(twist: FloatArray, across: FloatArray, config: ControllerConfig) -> FloatArray:
    """(n, 5) magnitudes of v, omega, the speed of either side at the rim, and the distance across the path."""
    v, omega = twist.T
    rim = 0.5 * config.wheels.track * omega
    return np.asarray(np.abs(np.column_stack([v, omega, v + rim, v - rim, across])))


def _soft_limits(config: ControllerConfig) -> FloatArray:
    lim = config.limits
    return np.array([lim.predicted_v, lim.predicted_omega, lim.wheel_speed, lim.wheel_speed, lim.corridor])
