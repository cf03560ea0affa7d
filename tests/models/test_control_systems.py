"""Conversion of models from and to systems of python-control: exact, with errors for invalid models."""

import control
import numpy as np
import pytest

from diffdrive_mpc import VelocityModel, load_model

DT = 0.0202
FREQUENCIES = np.logspace(-2, 2, 40)
UNIT_CIRCLE = np.exp(1j * np.linspace(0.01, 3.1, 40))
LAG, SECOND = control.tf([1.0], [0.1, 1.0]), control.tf([0.9], [0.05, 0.3, 1.0])


def response(system):
    points = UNIT_CIRCLE if system.dt else 1j * FREQUENCIES
    return np.array([np.reshape(system(point), (2, 2)) for point in points])


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm", "husky"])
def test_model_is_unchanged_by_a_round_trip_through_control(name):
    model = load_model(name).with_extra_dead_time([0.04, 0.03])
    converted = VelocityModel.from_control(model.to_control(), dead_time=model.dead_time)
    for matrix in ("A", "B", "C", "dead_time"):
        np.testing.assert_array_equal(getattr(converted, matrix), getattr(model, matrix))
    assert converted.name == model.name
    assert model.to_control().input_labels == ["v_ref", "omega_ref"]


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm"])
def test_transfer_function_responds_like_its_model(name):
    system = control.ss2tf(load_model(name).to_control())
    converted = VelocityModel.from_control(system).to_control()
    np.testing.assert_allclose(response(converted), response(system), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "form"), [("mbm", control.ss), ("sm", control.ss), ("ssm", control.ss), ("ssm", control.ss2tf)]
)
def test_discrete_system_is_inverted_exactly_with_its_delays(name, form):
    model = load_model(name)
    model = model.with_extra_dead_time(DT * np.array([5, 6]) - model.dead_time)
    system = form(model.to_control(DT))
    converted = VelocityModel.from_control(system)
    np.testing.assert_allclose(converted.dead_time, model.dead_time, atol=1e-15)
    np.testing.assert_allclose(response(converted.to_control(DT)), response(system), atol=1e-12)
    if form is control.ss:
        np.testing.assert_allclose(response(converted.to_control()), response(model.to_control()), atol=1e-12)


def test_discrete_system_includes_a_dead_time_of_a_fraction_of_a_sample():
    model = load_model("ssm").with_extra_dead_time([0.03, 0.0])
    commands = np.random.default_rng(0).normal(size=(60, 2))
    result = control.forced_response(model.to_control(DT), inputs=commands.T, timepts=np.arange(60) * DT)
    np.testing.assert_allclose(result.outputs.T, model.discretise(DT).simulate(commands), atol=1e-12)


def test_two_single_systems_become_v_and_omega():
    model = VelocityModel.from_control((LAG, SECOND), dead_time=(0.04, 0.02), name="mine")
    expected = np.array([[LAG(2j), 0.0], [0.0, SECOND(2j)]])
    np.testing.assert_allclose(model.to_control()(2j), expected, atol=1e-14)
    assert repr(model) == (
        "VelocityModel 'mine' (sm, order 3; v: gain 1, lag 140 ms of which 40 ms dead time; "
        "omega: gain 0.9, lag 320 ms of which 20 ms dead time)"
    )


def discrete(numerator, denominator, dt=0.02):
    return control.tf(numerator, denominator, dt)


def test_discrete_matrix_of_transfer_functions_is_converted_both_ways():
    delay = control.tf([1.0], [1.0, 0.0, 0.0], DT)
    v, omega, cross = (control.sample_system(part, DT) for part in (LAG, SECOND, 0.05 * LAG))
    system = control.combine_tf([[v * delay, cross], [cross * delay, omega]])
    model = VelocityModel.from_control(system)
    np.testing.assert_allclose(model.dead_time, [2 * DT, 0.0], atol=1e-15)
    np.testing.assert_allclose(response(model.to_control(DT)), response(system), atol=1e-12)
    expected = [[LAG(2j), 0.05 * LAG(2j)], [0.05 * LAG(2j), SECOND(2j)]]
    np.testing.assert_allclose(model.to_control()(2j), expected, atol=1e-12)


def test_powers_of_z_in_the_denominator_become_dead_time():
    model = VelocityModel.from_control((discrete([0.1], [1, -0.9, 0, 0]), discrete([0.2], [1, -0.8])), dead_time=0.01)
    np.testing.assert_allclose(model.dead_time, [0.05, 0.01], atol=1e-15)
    np.testing.assert_allclose(np.sort(model.poles.real), np.log([0.8, 0.9]) / 0.02, rtol=1e-12)
