"""Velocity models that are functions of a user, for tests."""

import casadi as ca
import numpy as np

from diffdrive_mpc import NonlinearModel, load_config

DT = load_config("ssm").sample_time
LAG = np.array([0.12, 0.09])


def saturating(most=(0.9, 1.8), delay=2, dt=DT):
    """v' = most tanh((v_ref - v) / (lag most)), the command being `delay` samples on its way; by Runge and Kutta."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (delay + 1))
    most = np.array(most)

    def rate(state):
        return most * ca.tanh((window[:2] - state) / (LAG * most))

    a = rate(x)
    b = rate(x + dt / 2 * a)
    c = rate(x + dt / 2 * b)
    d = rate(x + dt * c)
    step = ca.Function("step", [x, window], [x + dt / 6 * (a + 2 * b + 2 * c + d)], ["x", "window"], ["after"])
    return NonlinearModel("saturating", step, ca.Function("output", [x], [x], ["x"], ["y"]), dt, memory=delay)


def windowed(taps=6):
    """No states of its own: the next twist follows from the last commands alone, bent by tanh."""
    x, window = ca.SX.sym("x", 2), ca.SX.sym("window", 2 * (taps + 1))
    weights = np.exp(-0.5 * np.arange(taps)[::-1])
    weights /= weights.sum()
    commands = ca.reshape(window[: 2 * taps], 2, taps)
    after = 1.5 * ca.tanh(commands @ weights / 1.5)
    step = ca.Function("step", [x, window], [after], ["x", "window"], ["after"])
    return NonlinearModel("window", step, ca.Function("output", [x], [x], ["x"], ["y"]), DT, memory=taps)
