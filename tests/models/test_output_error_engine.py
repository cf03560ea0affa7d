"""Output-error engine: simulation compared with python-control and a recursion, and derivatives with differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification_parts import DT, published_ssm, set_points, single, system, two_channels
from scipy import signal

from diffdrive_mpc.models import load_model
from diffdrive_mpc.models.output_error.parameters import Layout
from diffdrive_mpc.models.output_error.problem import OutputErrorProblem
from diffdrive_mpc.models.output_error.state_space import (
    LocalStateSpace,
    StateResponse,
    balance,
    delay_inputs,
    from_impulse_response,
    impulse_response,
    sample,
    steady_start,
)
from diffdrive_mpc.models.output_error.statistics import residual_scale, sandwich, spike_weights
from diffdrive_mpc.models.output_error.validation import simulate_experiment
from diffdrive_mpc.models.structures.mbm import MotorsParametrisation
from diffdrive_mpc.models.structures.two_poles import TWO_POLES


@given(seed=st.integers(0, 10_000), n=st.integers(1, 5))
@settings(max_examples=30)
def test_states_equal_the_recursion(seed, n):
    stream = np.random.default_rng(seed)
    A = stream.normal(size=(n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    drive, start = stream.normal(size=(n, 3, 40)), stream.normal(size=(n, 3))
    states = StateResponse(A)(drive, start)
    x = start
    for k in range(40):
        assert states[:, :, k] == pytest.approx(x, abs=1e-9)
        x = A @ x + drive[:, :, k]


def test_states_are_exact_for_equal_poles():
    A = np.array([[0.9, 1.0], [0.0, 0.9]])
    states = StateResponse(A)(np.zeros((2, 1, 50)), np.array([[0.0], [1.0]]))
    k = np.arange(50)
    assert states[0, 0] == pytest.approx(k * 0.9 ** (k - 1.0), abs=1e-12)


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm"])
@given(dead_time=st.tuples(st.floats(0, 0.3), st.floats(0, 0.3)))
@settings(max_examples=20)
def test_sampling_equals_that_of_python_control(name, dead_time):
    model = load_model(name).with_extra_dead_time(dead_time)
    sampled, reference = sample(system(model), DT), model.discretise(DT)
    commands = set_points(0, 200, (0.5, 1.0))
    recent, previous = delay_inputs(commands, sampled.delay)
    states = StateResponse(sampled.A)((sampled.B0 @ recent + sampled.B1 @ previous)[:, None])[:, 0]
    past = np.tile(commands[0], (reference.memory, 1))
    assert pytest.approx(reference.simulate(commands, past=past), abs=1e-9) == states.T @ model.C.T


STRUCTURES = {
    "two poles": (
        Layout(TWO_POLES, 1, 1, offset=(True,), limited=((True, True, False, False),)),
        [np.log(0.9), np.log(0.2), np.log(0.05), 0.043, 0.1, 0.7, 0.5],
    ),
    "ramps": (
        Layout(TWO_POLES, 1, 1, limited=((True,) * 4,)),
        [np.log(0.9), np.log(0.2), np.log(0.05), 0.043, 0.7, 0.5, 1.1, 2.3],
    ),
    "state space": (
        Layout(LocalStateSpace(*balance(*(getattr(load_model("ssm"), x) for x in "ABC"))), 2, 2, offset=(False, True)),
        [*(0.1 * np.cos(np.arange(8.0))), 0.043, 0.09, 0.1],
    ),
    "motors": (
        Layout(MotorsParametrisation((-1, 1), 0.07), 2, 2),
        [*np.log([0.9, 0.2, 0.05, 1.1, 0.15, 0.06, 0.4]), 0.055, 0.072],
    ),
}


@pytest.mark.parametrize("has_prior", [False, True])
@pytest.mark.parametrize("name", STRUCTURES)
def test_gradient_equals_finite_differences(name, has_prior):
    """With a prior of the past, the settled initial state and its dependence on the parameters matter."""
    layout, parameters = STRUCTURES[name]
    parameters = np.array(parameters)
    stream = np.random.default_rng(0)
    inputs = set_points(1, 300, np.ones(layout.inputs), hold=30)
    outputs = stream.normal(size=(300, layout.outputs))
    outputs[0] = 0.0  # at rest the start of ramps does not depend on the gain
    experiment = single(inputs, outputs)
    weights = [stream.uniform(size=(300, layout.outputs))] * 2
    problem = OutputErrorProblem(layout, [experiment, experiment], weights)
    problem.set_prior(parameters, 0.01, np.full(2, float(has_prior)))
    gradient = problem.jacobian(parameters).T @ problem.residuals(parameters)
    for i, slope in enumerate(gradient):
        step = 1e-6 * np.eye(len(parameters))[i]
        high, low = (np.sum(problem.residuals(parameters + sign * step) ** 2) for sign in (1, -1))
        assert slope == pytest.approx((high - low) / 4e-6, rel=1e-4, abs=1e-4), layout.names[i]


def test_initial_state_has_no_residual():
    """The model that generated two experiments explains them exactly, although they start in motion."""
    model = published_ssm((0.04, 0.02))
    layout = Layout(LocalStateSpace(model.A, model.B, model.C), 2, 2)
    commands = set_points(2, 400, (0.5, 1.0))
    outputs = model.discretise(DT).simulate(commands)
    parts = [single(commands[rows], outputs[rows]) for rows in (slice(0, 170), slice(170, 400))]
    weights = [np.ones(part.outputs.shape) for part in parts]
    # The commands before a part act on its first samples, and are unknown.
    for weight in weights:
        weight[:3] = 0.0
    residuals = OutputErrorProblem(layout, parts, weights).residuals(np.array([0.0] * 8 + [0.04, 0.02]))
    assert np.abs(residuals).max() < 1e-9


def test_unstable_model_has_infinite_cost():
    layout = Layout(LocalStateSpace(np.eye(2), np.eye(2), np.eye(2)), 2, 2)
    problem = OutputErrorProblem(layout, [single(np.ones((30, 2)), np.ones((30, 2)))], [np.ones((30, 2))])
    assert np.isinf(problem.residuals(np.zeros(10))).all()


@given(seed=st.integers(0, 10_000), n=st.integers(1, 5))
@settings(max_examples=20)
def test_local_coordinates_omit_unobservable_directions(seed, n):
    """To first order, the n (m + p) coordinates contain no change of the state basis."""
    stream = np.random.default_rng(seed)
    A, B, C = stream.normal(size=(n, n)) - 3 * np.eye(n), stream.normal(size=(n, 2)), stream.normal(size=(2, n))
    structure = LocalStateSpace(A, B, C)
    assert structure.basis.shape == (n * (n + 4), 4 * n)
    unit = stream.normal(size=(n, n))
    move = np.concatenate([(A @ unit - unit @ A).ravel(), (-unit @ B).ravel(), (C @ unit).ravel()])
    assert structure.basis.T @ move == pytest.approx(np.zeros(4 * n), abs=1e-9)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 4))
@settings(max_examples=20)
def test_balancing_does_not_change_the_output(seed, n):
    stream = np.random.default_rng(seed)
    A, B, C = stream.normal(size=(n, n)), stream.normal(size=(n, 2)), stream.normal(size=(2, n))
    A -= (np.linalg.eigvals(A).real.max() + 1.0) * np.eye(n)
    balanced_system = balance(A, B, C)
    for s in (0.0, 1.0j, 5.0j):
        original, transformed = (c @ np.linalg.solve(s * np.eye(n) - a, b) for a, b, c in ((A, B, C), balanced_system))
        assert np.abs(transformed - original).max() < 1e-6 * (1 + np.abs(original).max())


def test_model_is_recovered_from_its_impulse_response():
    model = published_ssm((0.0, 0.0))
    commands = np.random.default_rng(5).normal(size=(3000, 2))
    outputs = model.discretise(DT).simulate(commands)
    response = impulse_response([single(commands, outputs)], np.zeros(2), 60)
    A, B, C = from_impulse_response(response, 2, DT)
    assert np.sort(np.linalg.eigvals(A)) == pytest.approx(np.sort(model.poles), rel=2e-2)
    # The response is truncated after 60 samples and regularised: it is only an initial guess.
    assert -C @ np.linalg.solve(A, B) == pytest.approx(model.dc_gain, abs=5e-2)


def test_simulation_starts_at_the_first_reading():
    model = two_channels((0.9, 10.0, 1.2), (0.6, 6.0, 0.7))
    outputs = np.tile([0.3, -0.2], (50, 1))
    settled_command = outputs[:1] / np.diag(model.dc_gain)
    experiment = single(np.tile(settled_command, (50, 1)), outputs)
    assert steady_start(system(model), outputs[0])[0] @ model.C.T == pytest.approx(outputs[0])
    assert simulate_experiment(system(model), experiment) == pytest.approx(outputs, abs=1e-12)


def test_weight_of_a_spike_is_reduced_and_that_of_a_lasting_error_is_not():
    residuals = 0.01 * np.random.default_rng(0).normal(size=(2000, 1))
    residuals[500] += 1.0
    residuals[1000:1040] += 0.3 * np.exp(-np.arange(40.0) / 10)[:, None]
    residuals[1500] = np.nan
    (weights,) = spike_weights([residuals])
    assert weights[500, 0] < 0.1
    assert weights[1002:1040].min() == 1.0
    assert np.mean(weights == 1.0) > 0.995


def test_readings_of_a_resting_robot_are_not_spikes():
    """Nine tenths of the residuals are zero; the others occasionally change by one count."""
    residuals = np.zeros((1000, 1))
    residuals[900:, 0] = 0.01 * np.random.default_rng(1).integers(-1, 2, 100)
    (weights,) = spike_weights([residuals])
    assert weights.min() > 0.1


def test_channel_without_readings_has_weights_and_no_warning():
    """Short stretches may contain no reading of a slow sensor; tests turn warnings into errors."""
    residuals = np.random.default_rng(2).normal(size=(100, 2))
    residuals[:, 1] = np.nan
    (weights,) = spike_weights([residuals])
    assert np.isfinite(weights).all()
    scale = residual_scale([residuals], [weights], np.ones(2))
    assert scale[0] == pytest.approx(1.0, abs=0.2) and scale[1] == 1e-9


def normalised_error(seed, drift, count=4000):
    """Compute the error of a gain over its stated deviation; the true gain drifts slowly about 1 by `drift`."""
    stream = np.random.default_rng(seed)
    command = np.repeat(stream.uniform(-1, 1, count // 40), 40)
    decay = np.exp(-10 / count)  # a tenth of the log
    drift_signal = signal.lfilter([np.sqrt(1 - decay**2)], [1.0, -decay], stream.normal(size=2 * count))[count:]
    output = command * (1.0 + drift * drift_signal) + 0.1 * stream.normal(size=count)
    gain = command @ output / (command @ command)
    error = output - gain * command
    scale = error.std()
    result = sandwich([-command[:, None, None] / scale], [error[:, None] / scale])
    return (gain - 1.0) / np.sqrt(result.covariance[0, 0])


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_intervals_have_the_stated_coverage_for_constant_and_drifting_gain(drift):
    coverage = np.mean([abs(normalised_error(seed, drift)) < 1.96 for seed in range(300)])
    assert 0.92 < coverage < 0.98
