"""The cost of a drive: by hand where it is simple, and its least where the drive is the reference."""

from types import SimpleNamespace

import numpy as np
import pytest

from diffdrive_mpc import load_config, load_model
from diffdrive_mpc.models.interface import ReferenceSample
from studies.speed.closed_loop_cost import closed_loop_cost

CONFIG, MODEL = load_config("ssm"), load_model("ssm")
TICKS = 40


def straight(times):
    """A reference at 0.4 m/s along x, for ever."""
    times = np.asarray(times)
    pose = np.column_stack([0.4 * times, 0 * times, 0 * times])
    return ReferenceSample(pose, np.tile([0.4, 0.0], (len(times), 1)), 0.4 * times)


REFERENCE = SimpleNamespace(sample=straight)


def cost(across=0.0, along=0.0, turned=0.0, v=0.4, omega=0.0, steady=True, config=CONFIG):
    """Cost of a drive that keeps a constant error, with the commands that hold the reference's twist."""
    pose = straight(CONFIG.sample_time * np.arange(TICKS)).pose + [along, across, turned]
    command = np.tile(np.linalg.solve(MODEL.dc_gain, [0.4, 0.0]), (TICKS, 1))
    value = closed_loop_cost(pose, np.tile([v, omega], (TICKS, 1)), command, REFERENCE, config, MODEL)
    first = command[0] ** 2 @ [config.weights.v_increment, config.weights.omega_increment] / 2 / TICKS
    return value - first


def test_on_the_reference_only_the_start_costs():
    assert cost() == pytest.approx(0.0, abs=1e-12)


def test_errors_cost_half_their_weighted_squares():
    w = CONFIG.weights
    assert cost(along=0.02) == pytest.approx(w.along * 0.02**2 / 2)
    assert cost(across=-0.03) == pytest.approx(w.across * 0.03**2 / 2)
    assert cost(turned=0.1 + 2 * np.pi) == pytest.approx(w.heading * 0.1**2 / 2)


def test_exceeded_soft_limits_cost_their_exact_and_quadratic_penalty():
    w, lim = CONFIG.weights, CONFIG.limits
    over = 0.1
    expected = w.soft * over + w.soft_quadratic * over**2 / 2
    assert cost(omega=lim.predicted_omega + over, v=0.0) == pytest.approx(expected)
    # One side turns too fast while v and omega alone are inside their limits.
    narrow = load_config("ssm", {"limits.wheel_speed": 0.55})
    v = 0.55 - 0.5 * CONFIG.wheels.track * 1.0 + over
    assert cost(v=v, omega=1.0, config=narrow) == pytest.approx(expected)


def test_a_drive_that_failed_has_no_cost():
    with pytest.raises(ValueError, match="must be finite"):
        cost(across=np.nan)
    with pytest.raises(ValueError, match="give"):
        closed_loop_cost(np.zeros((3, 3)), np.zeros((2, 2)), np.zeros((2, 2)), REFERENCE, CONFIG, MODEL)
