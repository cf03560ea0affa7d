"""Zero-order-hold sampling with dead time, held against an ODE solver and against invariants."""

import itertools
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from diffdrive_mpc.models import ModelError, load_model
from diffdrive_mpc.models.structures.model_file import TwoPoles, side_by_side

SSM = load_model("ssm")
dead_times = st.tuples(st.floats(0, 0.12), st.floats(0, 0.12))
sample_times = st.floats(0.004, 0.1)


def ode_outputs(model, commands, dt):
    """Outputs at the samples from an adaptive solver, stopped wherever a delayed command switches."""

    def command(t):
        index = np.floor((t - model.dead_time) / dt + 1e-9).astype(int)
        return np.array([commands[i, j] if i >= 0 else 0.0 for j, i in enumerate(index)])

    ends = {k * dt for k in range(len(commands))}
    switches = {k * dt + delay for k in range(len(commands)) for delay in model.dead_time}
    times = sorted(t for t in ends | switches if t <= (len(commands) - 1) * dt)
    x, outputs = np.zeros(model.order), {0.0: np.zeros(2)}
    for start, end in itertools.pairwise(times):
        if end - start < 1e-12:
            outputs[end] = model.C @ x
            continue
        u = command(0.5 * (start + end))
        x = solve_ivp(lambda _, x, u=u: model.A @ x + model.B @ u, (start, end), x, rtol=1e-10, atol=1e-12).y[:, -1]
        outputs[end] = model.C @ x
    return np.array([outputs[k * dt] for k in range(len(commands))])


@pytest.mark.parametrize("dead_time", [(0.0, 0.0), (0.0202, 0.0404), (0.04, 0.031), (0.007, 0.0999)])
def test_matches_an_ode_solver(dead_time):
    model = SSM.with_extra_dead_time(dead_time)
    commands = np.random.default_rng(1).normal(size=(40, 2))
    simulated = model.discretise(0.0202).simulate(commands)
    assert simulated == pytest.approx(ode_outputs(model, commands, 0.0202), abs=1e-8)


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm", "kinematic"])
@pytest.mark.parametrize("dead_time", [(0.0, 0.0), (0.007, 0.0999)])
def test_it_is_the_zero_order_hold_of_control(name, dead_time):
    model, dt = replace(load_model(name), dead_time=np.array(dead_time)), 0.0202
    discrete = model.discretise(dt)

    def held(time):
        return control.sample_system(control.ss(model.A, model.B, model.C, 0 * model.C @ model.B), time, "zoh")

    whole, rest = held(dt), np.array(dead_time) - discrete.delay * dt
    acting = np.column_stack([held(dt - rest[j]).B[:, j] for j in (0, 1)])
    assert pytest.approx(whole.A, rel=1e-13, abs=1e-15) == discrete.A
    assert pytest.approx(acting, rel=1e-13, abs=1e-15) == discrete.B0
    assert pytest.approx(whole.B, rel=1e-13, abs=1e-15) == discrete.B0 + discrete.B1
    assert not discrete.D.any()
    assert discrete.delay.tolist() == [0, 4 if any(dead_time) else 0]


def test_channels_side_by_side_are_what_control_appends():
    parts = [TwoPoles(gain=0.9, natural_frequency=7.0, damping=1.2), TwoPoles(gain=1.1, natural_frequency=9, damping=2)]
    whole = control.append(*(control.ss(*part.matrices(), 0.0) for part in parts))
    for ours, theirs in zip(side_by_side(parts), (whole.A, whole.B, whole.C), strict=True):
        assert np.array_equal(ours, theirs)


@given(dead_times, sample_times)
def test_the_steady_state_gain_survives_any_sampling(dead_time, dt):
    assert SSM.with_extra_dead_time(dead_time).discretise(dt).dc_gain == pytest.approx(SSM.dc_gain, abs=1e-9)


@given(dead_times, st.floats(0.01, 0.06))
def test_two_half_samples_make_a_whole_one(dead_time, dt):
    model = SSM.with_extra_dead_time(dead_time)
    commands = np.random.default_rng(2).normal(size=(25, 2))
    whole = model.discretise(dt).simulate(commands)
    halves = model.discretise(dt / 2).simulate(np.repeat(commands, 2, axis=0))
    assert whole == pytest.approx(halves[::2], abs=1e-9)


@given(dead_times)
def test_a_settled_robot_stays_settled(dead_time):
    discrete = SSM.with_extra_dead_time(dead_time).discretise(0.0202)
    command = np.array([0.6, -0.4])
    past = np.tile(command, (discrete.memory, 1))
    outputs = discrete.simulate(np.tile(command, (30, 1)), discrete.settled_state(command), past)
    assert outputs == pytest.approx(np.tile(SSM.dc_gain @ command, (30, 1)), abs=1e-12)


@given(st.integers(0, 5), sample_times)
def test_whole_samples_of_dead_time_only_shift(samples, dt):
    commands = np.random.default_rng(3).normal(size=(20, 2))
    plain = SSM.discretise(dt).simulate(commands)
    delayed = SSM.with_extra_dead_time([samples * dt] * 2).discretise(dt)
    assert delayed.delay.tolist() == [samples, samples]
    assert delayed.simulate(commands)[samples:] == pytest.approx(plain[: 20 - samples], abs=1e-12)


@pytest.mark.parametrize("dt", [0.0, -0.02, float("nan"), float("inf")])
def test_a_sample_time_that_is_none_is_refused(dt):
    with pytest.raises(ModelError, match="sample time"):
        SSM.discretise(dt)
