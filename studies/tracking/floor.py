"""Lower bound of the tracking error of a linear robot with Gaussian noise: LQG control about the twists of a path.

The states are those of the velocity model with its delayed commands, the pose error in the frame of the reference, the
past pose errors that delayed measurements contain, and the last command. The sensor set defines the measurements. The
estimator is the stationary Kalman filter, and the controller the infinite-horizon LQR with the weights of the
configuration. Limits are not active, and slip and gyro bias are known. Source: Anderson, Moore, Optimal Control: Linear
Quadratic Methods, 1990, chapter 8.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov

from diffdrive_mpc import ControllerConfig, VelocityModel, load_config, load_trajectory
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set
from studies.tracking.known_plant import reference_drive

_MIN_SHARE = 0.03
"""Minimum share of the duration that a twist must have to be included [-]; twists of ramps have smaller shares."""
_MIN_DEVIATION = 1e-6
"""Minimum standard deviation in the unit of each sensor; the Riccati equation requires positive variances."""
_SCALE = 1e6
"""Factor of the covariances in the Riccati equation, which is well conditioned in mm^2 but not in m^2."""


class LinearLoop(NamedTuple):
    """Linear system x[k+1] = A x[k] + B u[k] + w[k], z[k] = C x[k] + n[k] with cost x'Q x + 2 x'N u + u'R u.

    `disturbance` and `noise` are the covariances of w and n. `position` is the slice of the position errors along and
    across the path [m] in the state.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    disturbance: FloatArray
    noise: FloatArray
    Q: FloatArray
    R: FloatArray
    N: FloatArray
    position: slice


class PositionFloor(NamedTuple):
    """Lower bounds of the RMS position errors [m] of the estimate, and of the robot (`total`)."""

    estimate: float
    total: float


def linear_loop(
    config: ControllerConfig, model: VelocityModel, twist: ArrayLike, sensors: SensorSet, command_noise: ArrayLike
) -> LinearLoop:
    """Linearise robot, sensors and cost about a twist (v [m/s], omega [rad/s]).

    The disturbance is white noise on v_ref [m/s] and omega_ref [rad/s] with the standard deviations `command_noise`
    (2,).
    """
    dt = config.sample_time
    weights = with_increments(config, model.discretise(dt)).weights
    plant = model.to_control(dt)
    a, b, c = (np.asarray(matrix) for matrix in (plant.A, plant.B, plant.C))
    (v, omega), n, delay = np.asarray(twist, dtype=float), len(a), round(sensors.pose.latency / dt)
    transition = expm(dt * np.array([[0, omega, 0, 1, 0], [-omega, 0, v, 0, 0], [0, 0, 0, 0, 1], [0] * 5, [0] * 5]))
    drive, poses = 0.5 * transition[:3, 3:] @ c, 3 * (1 + delay)
    A, B, C = np.zeros((n + poses + 2,) * 2), np.zeros((n + poses + 2, 2)), np.zeros((6, n + poses + 2))
    A[:n, :n], A[n : n + 3, :n], A[n : n + 3, n : n + 3] = a, drive @ (np.eye(n) + a), transition[:3, :3]
    A[n + 3 : n + poses, n : n + poses - 3] = np.eye(poses - 3)
    B[:n], B[n : n + 3] = b, drive @ b
    noise_input = B * np.asarray(command_noise, dtype=float)
    B[-2:] = np.eye(2)
    C[:3, :n], C[3:, n + poses - 3 : n + poses] = c[[0, 1, 1]], np.eye(3)
    # v is the mean of the speeds of four wheels, and omega is the difference of the mean speeds of two wheels per side.
    rim, pose = sensors.encoders.speed_sd * load_robot().wheel_radius, sensors.pose
    deviations = [rim / 2, rim / load_robot().track, sensors.gyro.noise_sd, *[pose.position_sd] * 2, pose.heading_sd]
    Q, N = np.zeros_like(A), np.zeros_like(B)
    increments = np.diag([weights.v_increment, weights.omega_increment])
    Q[range(n, n + 3), range(n, n + 3)] = weights.along, weights.across, weights.heading
    Q[-2:, -2:], N[-2:] = increments, -increments
    R = increments + np.diag([weights.v, weights.omega])
    noise = np.diag(np.maximum(deviations, _MIN_DEVIATION) ** 2)
    return LinearLoop(A, B, C, noise_input @ noise_input.T, noise, Q, R, N, slice(n, n + 2))


def stationary_covariances(loop: LinearLoop) -> tuple[FloatArray, FloatArray]:
    """Compute the stationary covariances of the estimation error and of the state."""
    A, B, C = loop.A, loop.B, loop.C
    cost_to_go = solve_discrete_are(A, B, loop.Q, loop.R, s=loop.N)
    gain = np.linalg.solve(loop.R + B.T @ cost_to_go @ B, B.T @ cost_to_go @ A + loop.N.T)
    prior = solve_discrete_are(A.T, C.T, _SCALE * loop.disturbance, _SCALE * loop.noise) / _SCALE
    correction = prior @ C.T @ np.linalg.solve(C @ prior @ C.T + loop.noise, C @ prior)
    # The input of the estimate, the innovation, is white noise with the covariance `correction` in the state. Estimate
    # and estimation error are uncorrelated, so their covariances add up to that of the state.
    return prior - correction, prior - correction + solve_discrete_lyapunov(A - B @ gain, correction)


def command_noise(model: VelocityModel, trajectory: str, dt: float) -> FloatArray:
    """Compute the standard deviations (2,) of white noise on the commands that explain the open-loop error of a model.

    The noise causes the same RMS errors of v and omega as the simulation of the model along a trajectory, relative to
    the true twist of the mujoco plant.
    """
    log, plant = reference_drive("mujoco", "default", trajectory), model.to_control(dt)
    errors = log.true_twist[:, [0, 2]] - model.discretise(dt).simulate(log.command)
    unit_noise_variances = [
        plant.C[j] @ solve_discrete_lyapunov(plant.A, np.outer(b, b)) @ plant.C[j] for j, b in enumerate(plant.B.T)
    ]
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0) / unit_noise_variances))


@cache
def position_floor(name: str, trajectory: str, sensors: str, *, assumed: bool = False) -> PositionFloor:
    """Compute the RMS of the lower bounds for the constant twists of a path, weighted by the durations of the twists.

    The disturbance is `command_noise`, or with `assumed` the filter's `v_input_noise` and `omega_input_noise`.
    """
    config, path = load_config(name), load_trajectory(trajectory)
    extra, dt, estimator = config.extra_dead_time, config.sample_time, config.estimator
    model = load_linear_model(config.model).with_extra_dead_time((extra.v, extra.omega))
    noise = [estimator.v_input_noise, estimator.omega_input_noise] if assumed else command_noise(model, trajectory, dt)
    twists = path.sample(np.arange(0.0, path.duration, dt)).twist.round(3)
    values, counts = np.unique(twists, axis=0, return_counts=True)
    is_included = (counts >= _MIN_SHARE * len(twists)) & values.any(axis=1)
    squares = []
    for twist in values[is_included]:
        loop = linear_loop(config, model, twist, load_sensor_set(sensors), noise)
        squares.append([np.trace(matrix[loop.position, loop.position]) for matrix in stationary_covariances(loop)])
    return PositionFloor(*np.sqrt(np.average(squares, axis=0, weights=counts[is_included])))
