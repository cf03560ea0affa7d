"""Structures of models: registration of user structures, the published SSM, and sampling."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import control
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from log_parts import drive, write_csv, write_mapping
from scipy.integrate import solve_ivp

from diffdrive_mpc import ConfigError, identify, load_model
from diffdrive_mpc.models.checked_yaml import StrictModel
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures import registry
from diffdrive_mpc.models.structures.identified import IdentifiedModel, round_values
from diffdrive_mpc.models.structures.model_file import ModelFile, TwoPoles, side_by_side, structure_name
from diffdrive_mpc.models.structures.structure import IdentificationConditions, Structure, StructureFit


class Lag(StrictModel):
    gain: Positive
    time: Positive


class LagsFile(ModelFile):
    """Model file with one lag per channel."""

    structure: Literal["lags"]
    v: Lag
    omega: Lag

    def matrices(self):
        rates = 1 / np.array([self.v.time, self.omega.time])
        return -np.diag(rates), np.diag(rates * [self.v.gain, self.omega.gain]), np.eye(2)


def identify_lags(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Fit the change from sample to sample by least squares."""
    values = []
    for row in (0, 1):
        outputs = [(r.twist[:, 0], r.yaw_rate)[row] for r in records]
        change = np.concatenate([np.diff(y) for y in outputs])
        pairs = zip(outputs, records, strict=True)
        inputs = np.concatenate([np.column_stack([y[:-1], r.command[:-1, row]]) for y, r in pairs])
        decay, drive = np.linalg.lstsq(inputs, change, rcond=None)[0]
        values += [-drive / decay, -records[0].dt / np.log(1 + decay)]
    names = ("v.gain", "v.time", "omega.gain", "omega.time")
    by_name = dict(zip(names, values, strict=True))
    content = {
        name: {key: round_values(by_name[f"{name}.{key}"]) for key in ("gain", "time")} for name in ("v", "omega")
    }
    parameters = ParameterEstimate(names, np.array(values), 1e-6 * np.eye(4))
    model = IdentifiedModel(LagsFile, content, parameters, np.zeros(2), conditions.yaw, "regression", (), ())
    return StructureFit(model)


@pytest.fixture
def lags(monkeypatch):
    """Register the structure of one lag per channel."""
    monkeypatch.setitem(registry.STRUCTURES, "lags", Structure("lags", LagsFile, identify_lags))


@pytest.fixture
def log(tmp_path):
    write_mapping(tmp_path / "map.yaml")
    return write_csv(tmp_path / "drive.csv", drive(seconds=20.0))


def test_user_structure_is_identified_written_and_loaded(lags, log, tmp_path):
    identified = identify(log, tmp_path / "map.yaml", "lags")
    identified.write(tmp_path / "mine")
    model = load_model(tmp_path / "mine" / "model.yaml")
    assert model.structure == "lags"
    assert np.diag(model.dc_gain) == pytest.approx([1.0, 1.0], abs=0.02)
    assert model.lag == pytest.approx([0.1, 0.1], abs=0.02)
    assert identified.report.fitted.validation.fit_percent.min() > 90.0
    assert "LAGS from drive" in str(identified)


def test_two_delays_have_the_lags_of_sm_as_dead_times(log, tmp_path):
    fits = {name: identify(log, tmp_path / "map.yaml", name) for name in ("sm", "two_delays")}
    sm, delays = (fit.report.fitted.identified.model for fit in fits.values())
    assert delays.dead_time == pytest.approx(sm.lag, abs=1e-3)
    assert delays.lag - delays.dead_time == pytest.approx([1 / 900, 1 / 900], rel=0.01)
    np.testing.assert_allclose(np.diag(delays.dc_gain), np.diag(sm.dc_gain), rtol=1e-6)
    fits["two_delays"].write(tmp_path / "mine")
    assert load_model(tmp_path / "mine" / "model.yaml").structure == "two_delays"


def test_unregistered_structure_is_refused(log, tmp_path):
    with pytest.raises(ConfigError, match="structure 'lags': give one of mbm, sm, ssm"):
        identify(log, tmp_path / "map.yaml", "lags")
    content = {"name": "x", "structure": "lags", "provenance": {"origin": "identified", "source": "x"}}
    (tmp_path / "lags.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match="structure: expected one of mbm, sm, ssm.*, found 'lags'"):
        load_model(tmp_path / "lags.yaml")


@pytest.mark.parametrize("name", registry.STRUCTURES)
def test_registry_uses_the_names_of_the_files(name):
    structure = registry.STRUCTURES[name]
    assert structure.name == name == structure_name(structure.file)
    assert is_shipped(name) == (name != "mbm_modes")
    assert not is_shipped(name) or load_model(name).structure == name


def test_kinematic_model_is_sm_without_lag():
    """The model has the gains of SM and an assumed origin; its response ends after one sample."""
    kinematic, sm = load_model("kinematic"), load_model("sm")
    assert kinematic.provenance["origin"] == "assumed"
    np.testing.assert_allclose(kinematic.dc_gain, sm.dc_gain, rtol=1e-12)
    sampled = kinematic.discretise(0.0202)
    assert sampled.delay.tolist() == [0, 0]
    commands = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 0.0]])
    expected = np.vstack([np.zeros(2), commands[:-1] @ kinematic.dc_gain.T])
    np.testing.assert_allclose(sampled.simulate(commands), expected, atol=1e-6)


# Guffanti, Pavon, Sensors 2025, 25(18), 5821: numerators (s, 1) over the common denominator, as printed: without
# minus signs, and with the two cross terms exchanged.
PUBLISHED = {(0, 0): (7.428, 98.86), (1, 1): (14.26, 105.9), (0, 1): (0.1981, 0.01966), (1, 0): (1.013, 0.9052)}
PUBLISHED_DENOMINATOR = (1.0, 20.69, 98.62)
PUBLISHED_DIGITS = 4


def coefficients(A, B, C):
    """Return the numerators by (output, input), and the denominator."""
    numerators = {}
    for output, channel in PUBLISHED:
        tf = control.ss2tf(control.ss(A, B[:, [channel]], C[[output]], 0))
        num = np.atleast_1d(tf.num[0][0])
        numerators[output, channel] = np.pad(num, (3 - len(num), 0))[-2:]
        denominator = tf.den[0][0]
    return numerators, denominator


def half_digit(values):
    """Return half a unit of the last printed significant digit."""
    values = np.abs(np.asarray(values, dtype=float))
    return 0.5 * 10.0 ** (np.floor(np.log10(values)) - PUBLISHED_DIGITS + 1)


def rounding_bounds(model):
    """Bound the change of the coefficients if every matrix entry changes by half its last printed digit."""
    nominal, nominal_den = coefficients(model.A, model.B, model.C)
    bounds = {key: np.zeros(2) for key in nominal}
    den_bound = np.zeros(3)
    for name in "ABC":
        matrix = getattr(model, name)
        for index, step in np.ndenumerate(half_digit(matrix)):
            perturbed = {label: getattr(model, label).copy() for label in "ABC"}
            perturbed[name][index] += step
            numerators, denominator = coefficients(perturbed["A"], perturbed["B"], perturbed["C"])
            for key in bounds:
                bounds[key] += np.abs(numerators[key] - nominal[key])
            den_bound += np.abs(denominator - nominal_den)
    return nominal, nominal_den, bounds, den_bound


def test_transfer_functions_agree_to_the_rounding_of_the_matrices():
    nominal, denominator, bounds, den_bound = rounding_bounds(load_model("ssm"))
    for key, published in PUBLISHED.items():
        tolerance = bounds[key] + half_digit(published)
        assert (np.abs(np.abs(nominal[key]) - published) <= tolerance).all(), (key, nominal[key], published, tolerance)
    assert (np.abs(denominator - PUBLISHED_DENOMINATOR)[1:] <= (den_bound + [0, 0.005, 0.005])[1:]).all()


def test_poles_gains_and_lags_equal_the_published_values():
    model = load_model("ssm")
    assert np.sort(model.poles) == pytest.approx([-13.25, -7.44], abs=0.01)
    assert model.dc_gain == pytest.approx(np.array([[1.0026, -0.0002], [0.0092, 1.073]]), abs=5e-4)
    assert model.lag == pytest.approx([0.135, 0.075], abs=5e-4)
    assert (model.dead_time == 0).all()


SSM = load_model("ssm")
dead_times = st.tuples(st.floats(0, 0.12), st.floats(0, 0.12))


def ode_outputs(model, commands, dt):
    """Compute outputs at the samples with an adaptive solver, interrupted at every switch of a delayed command."""

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
def test_simulation_matches_an_ode_solver(dead_time):
    model = SSM.with_extra_dead_time(dead_time)
    commands = np.random.default_rng(1).normal(size=(40, 2))
    simulated = model.discretise(0.0202).simulate(commands)
    assert simulated == pytest.approx(ode_outputs(model, commands, 0.0202), abs=1e-8)


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm", "kinematic"])
@pytest.mark.parametrize("dead_time", [(0.0, 0.0), (0.007, 0.0999)])
def test_discretisation_is_the_zero_order_hold_of_control(name, dead_time):
    model, dt = replace(load_model(name), dead_time=np.array(dead_time)), 0.0202
    discrete = model.discretise(dt)

    def zero_order_hold(time):
        return control.sample_system(control.ss(model.A, model.B, model.C, 0 * model.C @ model.B), time, "zoh")

    full_step, fraction = zero_order_hold(dt), np.array(dead_time) - discrete.delay * dt
    expected = np.column_stack([zero_order_hold(dt - fraction[j]).B[:, j] for j in (0, 1)])
    assert pytest.approx(full_step.A, rel=1e-13, abs=1e-15) == discrete.A
    assert pytest.approx(expected, rel=1e-13, abs=1e-15) == discrete.B0
    assert pytest.approx(full_step.B, rel=1e-13, abs=1e-15) == discrete.B0 + discrete.B1
    assert not discrete.D.any()
    assert discrete.delay.tolist() == [0, 4 if any(dead_time) else 0]


def test_side_by_side_channels_equal_those_appended_by_control():
    parts = [TwoPoles(gain=0.9, natural_frequency=7.0, damping=1.2), TwoPoles(gain=1.1, natural_frequency=9, damping=2)]
    expected = control.append(*(control.ss(*part.matrices(), 0.0) for part in parts))
    for matrix, expected_matrix in zip(side_by_side(parts), (expected.A, expected.B, expected.C), strict=True):
        assert np.array_equal(matrix, expected_matrix)


@given(dead_times)
def test_response_of_a_settled_robot_is_constant(dead_time):
    discrete = SSM.with_extra_dead_time(dead_time).discretise(0.0202)
    command = np.array([0.6, -0.4])
    past = np.tile(command, (discrete.memory, 1))
    outputs = discrete.simulate(np.tile(command, (30, 1)), discrete.settled_state(command), past)
    assert outputs == pytest.approx(np.tile(SSM.dc_gain @ command, (30, 1)), abs=1e-12)
