"""The complete tracking problem as a CasADi nonlinear program for IPOPT, without linearisation."""

from __future__ import annotations

import casadi as ca
import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from oracle.problem import TrackingProblem, roll_out
from oracle.tick import Tick


def _arc(pose: ca.MX, v: ca.MX, omega: ca.MX, dt: float, lateral: ca.MX, slide: tuple[float, float]) -> ca.MX:
    half = omega * dt / 2
    # The unused branch must be finite as well; otherwise its derivative makes the result NaN.
    small = ca.fabs(half) < 1e-2
    safe = ca.if_else(small, 1, half)
    chord = dt * ca.if_else(small, 1 - half**2 / 6 + half**4 / 120, ca.sin(safe) / safe)
    c, s = ca.cos(pose[2] + half), ca.sin(pose[2] + half)
    rate = ca.sqrt(omega**2 + 0.05**2) - 0.05
    v, lateral = v + rate * (c * slide[0] + s * slide[1]) / 2, lateral + rate * (c * slide[1] - s * slide[0])
    return pose + ca.vertcat(chord * (v * c - lateral * s), chord * (v * s + lateral * c), omega * dt)


def nonlinear_program(
    problem: TrackingProblem, tick: Tick, ahead: FloatArray | None = None
) -> tuple[dict[str, ca.MX], dict[str, FloatArray]]:
    """Build the program with x = (U, p, m), p and m >= 0 (5 N each) the excesses above and below, and its bounds.

    The first 2 N entries of a solution are the commands, step by step. `ahead` (N,) fixes the turning points [m];
    if None, they depend on the plan.
    """
    N, model, w, slip = problem.steps, problem.model, problem.config.weights, tick.slip
    U, p, m = ca.MX.sym("U", 2, N), ca.MX.sym("p", 5, N), ca.MX.sym("m", 5, N)
    # The twists of the model are linear in the commands: the free response plus the response to each command.
    free_response = roll_out(model, tick.state, tick.past, np.zeros((N, 2, 1)), tick.late)[:, :, 0]
    zero_inputs = np.zeros(model.order), np.zeros_like(tick.past)
    command_response = roll_out(model, *zero_inputs, np.eye(2 * N).reshape(N, 2, 2 * N), tick.late)
    model_twist = ca.DM(free_response.T) + ca.reshape(ca.DM(command_response.reshape(-1, 2 * N)) @ ca.vec(U), 2, N + 1)
    wheels = model_twist + ca.DM(slip.offset)
    point = ca.diag(slip.gains) @ wheels
    twist = ca.vertcat(point[0, :] + slip.turn_left * point[1, :], point[1, :])
    acceleration = (twist[0, 1:] - twist[0, :-1]) / model.dt
    lever = slip.turn_ahead - slip.load_shift * acceleration if ahead is None else ca.MX(ca.DM(ahead).T)
    mean = (twist[:, :-1] + twist[:, 1:]) / 2
    pose, cost, across = ca.MX(tick.pose), ca.MX(0), []
    for k in range(N):
        v, omega = mean[0, k], mean[1, k]
        lateral = -omega * (lever[k] + slip.side_slip * v)
        pose = _arc(pose, v, omega, model.dt, lateral, (slip.slide_x, slip.slide_y))
        x, y, theta = tick.aim[k + 1]
        dx, dy, c, s = pose[0] - x, pose[1] - y, np.cos(theta), np.sin(theta)
        errors = ca.vertcat(c * dx + s * dy, c * dy - s * dx, pose[2] - tick.heading[k + 1])
        across.append(errors[1])
        factor = w.terminal if k == N - 1 else 1.0
        cost += factor * ca.dot([w.along, w.across, w.heading], errors**2) / 2
    by_reference = np.diff(np.vstack([tick.fed_before, tick.feed_forward]), axis=0).T
    increment = U - ca.horzcat(tick.last_command, U[:, :-1]) - by_reference
    cost += ca.dot([w.v, w.omega], ca.sum2((U - tick.feed_forward.T) ** 2)) / 2
    cost += ca.dot([w.v_increment, w.omega_increment], ca.sum2(increment**2)) / 2
    cost += w.soft * ca.sum1(ca.vec(p + m)) + w.soft_quadratic * (ca.sumsqr(p) + ca.sumsqr(m)) / 2
    half_track = problem.config.wheels.track / 2
    right, left = wheels[0, 1:] + half_track * wheels[1, 1:], wheels[0, 1:] - half_track * wheels[1, 1:]
    soft = ca.vertcat(twist[:, 1:], right, left, ca.horzcat(*across)) - p + m

    _, soft_now = problem.outcome(tick, np.zeros((N, 2, 1)), np.zeros(N))
    limit = np.tile(problem.soft_limits(soft_now[:, 0, 0]), N)
    _, lower, upper = problem.hard_limits(tick, tick.feed_forward)
    slack, n = np.zeros(10 * N), 2 * N
    rows = ca.veccat(U - ca.horzcat(np.zeros(2), U[:, :-1]), soft)
    program = {"x": ca.veccat(U, p, m), "f": cost, "g": rows}
    bounds = {
        "lbx": np.concatenate([lower[:n], slack]),
        "ubx": np.concatenate([upper[:n], slack + np.inf]),
        "lbg": np.concatenate([lower[n:], -limit]),
        "ubg": np.concatenate([upper[n:], limit]),
    }
    return program, bounds
