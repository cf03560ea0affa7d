"""Without limits the first command is that of a linear-quadratic regulator with preview, by a Riccati recursion."""

import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot
from nonlinear_program import NO_SLIP, feed_forward, record

from diffdrive_mpc import Controller, load_config
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

STEPS = 25


def ramps():
    """Return a straight path whose speed ramps up and down."""
    times = np.linspace(0.0, 4.0, 81)
    poses = np.column_stack([0.3 * times - 0.1 * np.sin(np.pi * times), 0 * times, 0 * times])
    rates = np.column_stack([0.3 - 0.1 * np.pi * np.cos(np.pi * times), 0 * times, 0 * times])
    return SplineTrajectory.through("ramps", times, poses, rates)


def regulator(model, weights, state, past, last, error, twists, fed):
    """Return v_ref (1,) of the regulator by dynamic programming.

    The state is (velocity states, commands on their way, position error, last deviation from the feed-forward, 1).
    `twists` (N + 1,) are the speeds of the reference, `fed` (N + 1,) its feed-forward from the last tick on.
    """
    n, m, dt = model.order, len(past), model.dt
    size = n + m + 3
    A, B = np.zeros((size, size)), np.zeros(size)
    A[:n, :n] = model.A
    place = n + m - 1 - int(model.delay[0])
    for matrix, column in ((model.B0, place + 1), (model.B1, place)):
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
        # Deviation d = u - fed costs weights.v; its change over the last one costs weights.v_increment.
        change = F[n + m + 1] - np.eye(size)[n + m + 1]
        R = B @ P @ B + weights.v + weights.v_increment
        S = B @ P @ F + weights.v * F[n + m + 1] + weights.v_increment * change
        Q = weights.v * np.outer(F[n + m + 1], F[n + m + 1]) + weights.v_increment * np.outer(change, change)
        P = F.T @ P @ F + Q - np.outer(S, S) / R
    return -S @ np.concatenate([state, past, [error, last - fed[0], 1.0]]) / R


@pytest.mark.parametrize("name", ["sm", "mbm"])
def test_first_command_equals_that_of_the_regulator_with_preview(name):
    controller = Controller(load_config(name, NO_SLIP | PROMPT | {"horizon": STEPS, "solver.tolerance": 1e-9}))
    model, dt, reference = controller.model.discretise(0.0202), 0.0202, ramps()
    robot = IdealRobot(model, np.array([0.03, 0.0, 0.0]))
    drive = record(controller, robot, reference, 70, lambda *_: None)
    t, steps = drive.times[-1], np.arange(STEPS + 1)
    # The last tick once more, from what the controller knows.
    result = controller.step(t + dt, robot.measure())
    t += dt
    past = np.array([[0.0, 0.0]] * 20 + drive.commands)[-model.memory :, 0]
    path = reference.sample(t + dt * steps)
    moved = np.diff(path.pose[:, 0]) / dt
    fed = feed_forward(controller, reference, t)[:, 0]
    error = result.estimate.pose[0] - path.pose[0, 0]
    wanted = regulator(model, controller.config.weights, result.estimate.state, past, past[-1], error, moved, fed)
    assert result.solver.method == "unlimited"
    assert result.command[0] == pytest.approx(wanted, abs=1e-6)
    assert abs(wanted - fed[1]) > 1e-4
