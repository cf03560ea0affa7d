"""Drives on the mujoco plant: lateral errors on commanded paths and at limits, and consistency of the estimator."""

import numpy as np
import pytest
from scipy.optimize import linprog

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import controller_config, run_case
from diffdrive_mpc.models.interface import Measurement
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.mpc.config.schema import Limits
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc.sim import make_plant, simulate

SPEED = 0.5  # m/s, of both paths
STEPS = {"s": 1.0, "cane": 0.7}  # maximum jump of the yaw rate of the path [rad/s]


def min_lateral_error(step: float) -> float:
    """Compute the minimum of the maximum lateral error [m] at a jump of the yaw rate, limited by the slew of omega.

    The error e satisfies e'' = v (omega - omega_path); omega may change before the jump. Solved as a linear program.
    """
    dt, count = 0.01, 160
    path = np.where(np.arange(count) < count // 2, 0.0, step)
    # Variables: omega, heading error and e at each instant, then the bound of |e|.
    shift, eye, zeros = np.diff(np.eye(count), axis=0), np.eye(count)[:-1], np.zeros((count - 1, count))
    dynamics = np.block([[-dt * eye, shift, zeros, zeros[:, :1]], [zeros, -dt * SPEED * eye, shift, zeros[:, :1]]])
    rhs = np.concatenate([-dt * path[:-1], np.zeros(count - 1)])
    slew = np.hstack([shift, zeros, zeros, zeros[:, :1]])
    errors = np.hstack([np.zeros((count, 2 * count)), np.eye(count)])
    bounded = np.vstack([np.hstack([sign * errors, -np.ones((count, 1))]) for sign in (1.0, -1.0)])
    upper = np.concatenate([np.full(2 * (count - 1), Limits().omega_slew * dt), np.zeros(2 * count)])
    ranges = [(None, None)] * (3 * count) + [(0.0, None)]
    for first, values in ((0, path), (count, np.zeros(count)), (2 * count, np.zeros(count))):
        for column in (0, count - 1):
            ranges[first + column] = (values[column], values[column])
    cost = np.append(np.zeros(3 * count), 1.0)
    result = linprog(cost, np.vstack([slew, -slew, bounded]), upper, dynamics, rhs, bounds=ranges, method="highs")
    assert result.status == 0
    return float(result.fun)


@pytest.mark.parametrize("path", STEPS)
@pytest.mark.parametrize("model", ["mbm", "sm", "ssm"])
def test_error_of_a_drive_without_stops_is_near_the_geometric_minimum(path, model):
    run = run_case(Case(model=model, trajectory=path, timing="commanded", seed=60))
    bound = min_lateral_error(STEPS[path])
    assert run.metrics.completed
    assert 1e-5 < bound < 0.002
    assert bound < run.metrics.lateral_max_m <= 0.02


EDGE_PATHS = ["fast_circle", "figure8", "slalom", "reverse_slalom", "k_turn", "spiral", "spline-0"]
WHEEL_SPEED = ("limits.wheel_speed", 1.53)


@pytest.mark.parametrize("name", EDGE_PATHS)
def test_path_at_the_limits_is_driven_to_its_end(name: str) -> None:
    run = run_case(Case(trajectory=name))
    assert run.metrics.completed
    assert run.metrics.fallbacks == 0
    assert run.metrics.in_band_percent == 100.0
    assert run.metrics.position_rmse_m < 0.025


@pytest.mark.parametrize("overrides", [(), (WHEEL_SPEED,)])
def test_limits_are_active_on_tight_for_about_half_of_the_time(overrides: tuple[tuple[str, object], ...]) -> None:
    run = run_case(Case(trajectory="tight", overrides=overrides))
    assert run.metrics.completed
    config = controller_config("ssm", overrides=overrides)
    limits = config.limits
    command = run.command[run.counted]
    change = np.abs(np.diff(command, axis=0, prepend=0.0)) / config.sample_time
    encoders = np.array(
        [measurement.wheel_twist.value for measurement in run.measurements if measurement.wheel_twist is not None]
    )
    rim = np.abs(encoders) @ (1.0, config.wheels.encoder_track / 2)
    active = {
        "command": (np.abs(command) >= np.array([limits.v, limits.omega]) - 1e-4).any(axis=1),
        "slew": (change >= 0.999 * np.array([limits.v_slew, limits.omega_slew])).any(axis=1),
        "wheels": rim[run.counted] >= 0.98 * limits.wheel_speed,
    }
    fractions = {name: rows.mean() for name, rows in active.items()}
    assert fractions["command"] > 0.05
    assert fractions["slew"] > 0.1
    # Within the shipped command limits, the wheel limits are never reached.
    assert (fractions["wheels"] > 0.05) == bool(overrides)
    assert 0.35 < (active["command"] | active["slew"] | active["wheels"]).mean() < 0.65


PATHS = ["circle", "square", "s", "cane"]
SETTLING_TICKS = 10
"""Ticks after which the filter has processed the first poses."""


def record_steps(controller: Controller) -> list[StepResult]:
    """Return a list to which each call of `step` appends its result."""
    steps, step = list[StepResult](), controller.step

    def step_and_record(t: float, measurement: Measurement) -> StepResult:
        steps.append(step(t, measurement))
        return steps[-1]

    controller.step = step_and_record
    return steps


def normalised_errors(model: str) -> tuple[dict[str, float], np.ndarray]:
    """Compute over four paths the mean normalised innovation per sensor and the mean normalised squared pose error."""
    innovations: dict[str, list[float]] = {}
    errors = []
    for trajectory in PATHS:
        controller = Controller(load_config(model))
        steps = record_steps(controller)
        run = simulate(controller, make_plant("mujoco", seed=20), load_trajectory(trajectory))
        for step, true_pose in zip(steps[SETTLING_TICKS:], run.true_pose[SETTLING_TICKS:], strict=True):
            for sensor, value in step.estimate.innovations.items():
                innovations.setdefault(sensor, []).append(value)
            error = step.estimate.pose - true_pose
            error[2] = wrap_angle(error[2])
            errors.append(np.square(error / step.estimate.pose_deviation))
    return {sensor: float(np.mean(values)) for sensor, values in innovations.items()}, np.mean(errors, axis=0)


@pytest.mark.parametrize("model", ["ssm", "sm"])
def test_innovations_and_errors_on_mujoco_match_the_variances_of_the_estimator(model: str) -> None:
    """Comments state the range over single runs with both models, four trajectories and seeds 20 to 24."""
    innovations, (x, y, heading) = normalised_errors(model)
    assert 0.75 < innovations["pose"] < 1.2  # 0.83 to 0.97
    assert 0.35 < innovations["wheel_speed"] < 1.5  # 0.38 to 0.99
    # The gyro corrects the prediction first; the wheels, which lag by over half a sample, correct the remaining error.
    assert 0.05 < innovations["yaw_rate"] < 1.0  # 0.12 (SM), 0.71 (SSM): means over trajectories at seed 20
    assert 0.75 < innovations["wheel_yaw_rate"] < 2.0  # 1.36 (SSM), 1.47 (SM)
    assert 0.3 < x < 1.0  # means over seeds: 0.43 to 0.47
    assert 0.3 < y < 1.0  # 0.45 to 0.49
    assert 0.5 < heading < 2.0  # 0.75 to 1.66
