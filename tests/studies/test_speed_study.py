"""Speed study: cost of closed loops."""

from types import SimpleNamespace

import numpy as np
import pytest

from diffdrive_mpc import load_config, load_model
from diffdrive_mpc.models.interface import ReferenceSample
from diffdrive_mpc.mpc.problem.margin import with_increments
from studies.speed.measure import closed_loop_cost

pytestmark = pytest.mark.system


MODEL = load_model("ssm")
CONFIG = with_increments(load_config("ssm"), MODEL.discretise(load_config("ssm").sample_time))
TICKS = 40


def straight(times):
    """Return samples of an endless reference at 0.4 m/s along x."""
    times = np.asarray(times)
    pose = np.column_stack([0.4 * times, 0 * times, 0 * times])
    return ReferenceSample(pose, np.tile([0.4, 0.0], (len(times), 1)), 0.4 * times)


REFERENCE = SimpleNamespace(sample=straight)


def cost(across=0.0, along=0.0, turn=0.0, v=0.4, omega=0.0, steady=True, config=CONFIG):
    """Compute the cost of a drive with a constant error, with the commands that keep the reference's twist."""
    pose = straight(CONFIG.sample_time * np.arange(TICKS)).pose + [along, across, turn]
    command = np.tile(np.linalg.solve(MODEL.dc_gain, [0.4, 0.0]), (TICKS, 1))
    value = closed_loop_cost(pose, np.tile([v, omega], (TICKS, 1)), command, REFERENCE, config, MODEL)
    first = command[0] ** 2 @ [config.weights.v_increment, config.weights.omega_increment] / 2 / TICKS
    return value - first


def test_cost_of_an_error_is_half_its_weighted_square():
    w = CONFIG.weights
    assert cost(along=0.02) == pytest.approx(w.along * 0.02**2 / 2)
    assert cost(across=-0.03) == pytest.approx(w.across * 0.03**2 / 2)
    assert cost(turn=0.1 + 2 * np.pi) == pytest.approx(w.heading * 0.1**2 / 2)


def test_exceeded_soft_limit_costs_the_exact_and_quadratic_penalty():
    w, limits = CONFIG.weights, CONFIG.limits
    excess = 0.1
    expected = w.soft * excess + w.soft_quadratic * excess**2 / 2
    assert cost(omega=limits.predicted_omega + excess, v=0.0) == pytest.approx(expected)
    # The wheels of one side turn too fast while v and omega are within their limits.
    low_limit = CONFIG.model_copy(update={"limits": CONFIG.limits.model_copy(update={"wheel_speed": 0.55})})
    v = 0.55 - 0.5 * CONFIG.wheels.track * 1.0 + excess
    assert cost(v=v, omega=1.0, config=low_limit) == pytest.approx(expected)
