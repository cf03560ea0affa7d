"""Weights of increments, computed from the delay margin of the closed loop."""

import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot
from nonlinear_program import NO_SLIP, feed_forward, record, saturating

from diffdrive_mpc import Controller, load_config, load_model
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.problem import margin
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

LIMITS = ("v", "omega", "v_slew", "omega_slew", "predicted_v", "predicted_omega", "wheel_speed", "corridor")
NOISES = ("position_noise", "heading_noise", "wheel_speed_noise", "wheel_yaw_rate_noise", "yaw_rate_noise")
IDEAL = {
    **{f"limits.{name}": 1e6 for name in LIMITS},
    **{f"estimator.{name}": 1e-6 for name in NOISES},
    **NO_SLIP,
    **PROMPT,
    "reentry.enabled": False,
}


def growth(channel, share):
    """Return the growth of an oscillation over 6 s with `share` of the margin of SM as unknown delay in a channel."""
    controller = Controller(load_config("sm", IDEAL | {"margin.v": 0.29, "margin.omega": 0.16}))
    margins = controller.config.margin
    lags = np.eye(2)[channel] * share * [margins.v, margins.omega]
    robot = IdealRobot(controller.model.with_extra_dead_time(lags).discretise(controller.sample_time), [0.0, 0.02, 0.0])
    t, zeros = np.linspace(0.0, 20.0, 201), np.zeros(201)
    path = np.column_stack([margin.SPEED * t, zeros, zeros]), np.column_stack([margin.SPEED + zeros, zeros, zeros])
    controller.start(SplineTrajectory.through("line", t, *path), 0.0)
    errors = []
    for _ in range(900):
        robot.advance(controller.step(robot.time, robot.measure()).command)
        errors.append((robot.pose - [margin.SPEED * robot.time, 0.0, 0.0])[channel])
    first_half, second_half = np.array(errors[300:]).reshape(2, 300)
    return second_half.std() / first_half.std()


@pytest.mark.parametrize("channel", [0, 1], ids=["v", "omega"])
def test_loop_is_stable_below_the_margin_and_unstable_above(channel):
    assert growth(channel, 0.9) < 0.7
    assert growth(channel, 1.1) > 1.4


def weights(overrides=None, name="sm"):
    config = Controller(load_config(name, overrides)).config
    return config.weights.v_increment, config.weights.omega_increment


def test_weights_equal_the_tuned_weights_of_sm_and_increase_with_the_margin():
    assert weights() == (5.0, 4.0)
    omega = [weights({"margin.omega": delay})[1] for delay in (0.1, 0.17, 0.2)]
    assert omega[0] == 4.0 < omega[1] < omega[2]
    assert weights({"margin.v": 0.3})[0] > 2 * weights()[0]


def test_configured_weights_replace_the_weights_of_the_margin():
    assert weights({"weights.v_increment": 3.0}) == (3.0, weights()[1])
    controller = Controller(load_config("sm", {"weights.omega_increment": 4.0}))
    problem = controller._problem(controller.config)
    assert problem.constants()["increment_weight"] == [weights()[0], 4.0]


def test_update_keeps_the_weights_of_the_start(monkeypatch):
    controller = Controller("sm")
    monkeypatch.setattr(margin, "_increment_weights", None)
    initial = controller.config.weights
    assert controller.update(weights={"across": 1200.0}).weights == initial.model_copy(update={"across": 1200.0})
    assert controller.update(weights={"v_increment": 7.0}).weights.v_increment == 7.0


def test_unreachable_margin_raises_config_error_and_default_margin_leaves_constants():
    assert weights({"horizon": 5})[1] == 4.0
    with pytest.raises(ConfigError, match=r"margin\.omega = 0\.6 s.*set a smaller margin"):
        weights({"margin.omega": 0.6})
    assert margin.with_increments(load_config("sm"), saturating()).weights.v_increment == 5.0
    # Zero and extreme weights raise no error.
    assert np.isfinite(weights({"weights.along": 0.0, "weights.heading": 1e12})).all()


def test_every_shipped_model_tolerates_its_margin():
    for name in ("mbm", "sm", "ssm", "kinematic"):
        config = load_config(name)
        model = load_model(name).discretise(config.sample_time)
        K = margin.feedback(model, config)(np.array(weights(name=name)))
        for delay in np.diag([config.margin.v, config.margin.omega]) / model.dt:
            assert margin.spectral_radius(model, K, 0.99 * delay) < 1.0


# Without limits, the first command equals that of a linear-quadratic regulator with preview (Riccati recursion).


STEPS = 25


def ramp_reference():
    """Return a straight path whose speed ramps up and down."""
    times = np.linspace(0.0, 4.0, 81)
    poses = np.column_stack([0.3 * times - 0.1 * np.sin(np.pi * times), 0 * times, 0 * times])
    rates = np.column_stack([0.3 - 0.1 * np.pi * np.cos(np.pi * times), 0 * times, 0 * times])
    return SplineTrajectory.through("ramps", times, poses, rates)


def regulator(model, weights, state, past, last, error, twists, fed):
    """Return v_ref (1,) of the regulator by dynamic programming.

    State: velocity states, delayed commands, position error, last deviation from the feed-forward, 1.
    `twists` (N + 1,) are speeds of the reference; `fed` (N + 1,) is its feed-forward, starting at the last tick.
    """
    n, m, dt = model.order, len(past), model.dt
    size = n + m + 3
    A, B = np.zeros((size, size)), np.zeros(size)
    A[:n, :n] = model.A
    column_before = n + m - 1 - int(model.delay[0])
    for matrix, column in ((model.B0, column_before + 1), (model.B1, column_before)):
        if column == n + m:
            B[:n] += matrix[:, 0]
        else:
            A[:n, column] += matrix[:, 0]
    A[n : n + m - 1, n + 1 : n + m] = np.eye(m - 1)
    B[n + m - 1] = 1.0
    mean = 0.5 * dt * (np.eye(n) + A[:n, :n]).T @ model.C[0]
    A[n + m, :n], A[n + m, n : n + m] = mean, 0.5 * dt * model.C[0] @ A[:n, n : n + m]
    B[n + m] = 0.5 * dt * model.C[0] @ B[:n]
    A[n + m, n + m] = A[-1, -1] = B[n + m + 1] = 1.0
    P = np.zeros((size, size))
    for k in reversed(range(STEPS)):
        F = A.copy()
        F[n + m, -1] = -dt * twists[k]
        F[n + m + 1, -1] = -fed[k + 1]
        P[n + m, n + m] += weights.along * (weights.terminal if k == STEPS - 1 else 1.0)
        # The deviation d = u - fed has the weight weights.v; its change has the weight weights.v_increment.
        change = F[n + m + 1] - np.eye(size)[n + m + 1]
        R = B @ P @ B + weights.v + weights.v_increment
        S = B @ P @ F + weights.v * F[n + m + 1] + weights.v_increment * change
        Q = weights.v * np.outer(F[n + m + 1], F[n + m + 1]) + weights.v_increment * np.outer(change, change)
        P = F.T @ P @ F + Q - np.outer(S, S) / R
    return -S @ np.concatenate([state, past, [error, last - fed[0], 1.0]]) / R


@pytest.mark.parametrize("name", ["sm", "mbm"])
def test_first_command_equals_the_regulator_with_preview(name):
    controller = Controller(load_config(name, NO_SLIP | PROMPT | {"horizon": STEPS, "solver.tolerance": 1e-9}))
    model, dt, reference = controller.model.discretise(0.0202), 0.0202, ramp_reference()
    robot = IdealRobot(model, np.array([0.03, 0.0, 0.0]))
    drive = record(controller, robot, reference, 70, lambda *_: None)
    t, steps = drive.times[-1], np.arange(STEPS + 1)
    # Repeat the last tick with the controller's estimate.
    result = controller.step(t + dt, robot.measure())
    t += dt
    past = np.array([[0.0, 0.0]] * 20 + drive.commands)[-model.memory :, 0]
    path = reference.sample(t + dt * steps)
    speeds = np.diff(path.pose[:, 0]) / dt
    fed = feed_forward(controller, reference, t)[:, 0]
    error = result.estimate.pose[0] - path.pose[0, 0]
    expected = regulator(model, controller.config.weights, result.estimate.state, past, past[-1], error, speeds, fed)
    assert result.solver.method == "unlimited"
    assert result.command[0] == pytest.approx(expected, abs=1e-6)
    assert abs(expected - fed[1]) > 1e-4
