"""The prediction matrices against a simulation of the same model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models import load_model
from diffdrive_mpc.mpc.problem.prediction import build_prediction

SSM = load_model("ssm")


@given(st.tuples(st.floats(0, 0.1), st.floats(0, 0.1)), st.integers(1, 25), st.integers(0, 1000))
def test_matches_simulation(dead_time, horizon, seed):
    model = SSM.with_extra_dead_time(dead_time).discretise(0.0202)
    prediction = build_prediction(model, horizon)
    rng = np.random.default_rng(seed)
    state, past, plan = rng.normal(size=model.order), rng.normal(size=(model.memory, 2)), rng.normal(size=(horizon, 2))
    predicted = (
        prediction.from_state @ state + prediction.from_past @ past.ravel() + prediction.from_plan @ plan.ravel()
    )
    simulated = model.simulate(np.vstack([plan, plan[-1:]]), state, past)
    assert predicted.reshape(-1, 2) == pytest.approx(simulated, abs=1e-10)


def test_heading_is_the_sum_of_mean_rates():
    model = SSM.discretise(0.05)
    prediction = build_prediction(model, 12)
    plan = np.random.default_rng(0).normal(size=24)
    twist = (prediction.from_plan @ plan).reshape(-1, 2)
    trapezoid = np.concatenate([[0], np.cumsum(0.05 * 0.5 * (twist[:-1, 1] + twist[1:, 1]))])
    assert prediction.heading_from_plan @ plan == pytest.approx(trapezoid, abs=1e-12)


def test_nothing_acts_before_its_dead_time():
    model = SSM.with_extra_dead_time([0.0606, 0.0202]).discretise(0.0202)
    plan = build_prediction(model, 8).from_plan.reshape(9, 2, 8, 2)
    for k in range(9):
        for j in range(8):
            assert plan[k, :, j, 0].any() == (j + 3 < k)
            assert plan[k, :, j, 1].any() == (j + 1 < k)


def test_no_horizon_no_prediction():
    with pytest.raises(ValueError, match="horizon = 0"):
        build_prediction(SSM.discretise(0.02), 0)
