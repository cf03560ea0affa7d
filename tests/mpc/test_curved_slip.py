"""Slip that curves the body's twist: prediction, estimation and settings."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ideal_robot import PROMPT, IdealRobot, drive

from diffdrive_mpc import (
    Controller,
    Measurement,
    NonlinearModel,
    Stamped,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
)
from diffdrive_mpc.models.slip_laws import POLYNOMIAL
from diffdrive_mpc.mpc.problem.constants import build_prediction
from diffdrive_mpc.mpc.problem.formulas import body_twist
from diffdrive_mpc.mpc.problem.slip import CURVED_SLIPS, SLIPS, Slip
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.load import load_segments
from diffdrive_mpc.mpc.trajectories.segments import time_segments
from diffdrive_mpc.sim.plants.surface import load_surface

DT = load_config("ssm").sample_time
# Plausible coefficients of a surface.
CURVES = {"crab": 0.0, "veer": 0.1, "forward_coupling": -0.1, "yaw_coupling": 0.3, "track_growth": 0.2}
COMPENSATIONS = ("delay", "v_offset", "yaw_gain", "side_slip")
PLAIN = {"weights.v_increment": 20.0, "weights.omega_increment": 15.0, "monitor.enabled": False}
PLAIN |= {f"compensation.{name}": False for name in COMPENSATIONS}


def estimator_settings(values):
    return {f"estimator.{name}": value for name, value in values.items()}


def curved_model(curves):
    """Return the nonlinear model whose output is the twist of the slipping body."""
    model = load_model("ssm").discretise(DT)
    x, window = ca.SX.sym("x", model.order), ca.SX.sym("window", 4)
    slip = Slip(**curves)
    twist = body_twist(ca.mtimes(model.C, x), ca.DM([getattr(slip, name) for name in SLIPS]))
    step = model.A @ x + model.B0 @ window[2:] + model.B1 @ window[:2]
    return NonlinearModel(
        "bent",
        ca.Function("step", [x, window], [step], ["x", "window"], ["x_next"]),
        ca.Function("output", [x], [twist], ["x"], ["y"]),
        DT,
        known_lag=load_model("ssm").lag,
    )


def commands_and_plans(controller, ticks):
    """Return commands and plans for a robot without slip and with pose measurements only."""
    robot = IdealRobot(load_model("ssm").discretise(DT), np.array([0.02, -0.03, 0.05]))
    path, seconds = load_trajectory("s"), ticks * DT
    results, _, _ = drive(controller, robot, path, seconds, change=lambda _, measurement: Measurement(measurement.pose))
    return np.array([result.command for result in results]), np.array([result.plan for result in results])


def test_curved_slip_is_predicted_like_an_equivalent_nonlinear_model():
    fixed = {f"{name}_uncertainty": 1e-9 for name in CURVES}
    curved = Controller(load_config("ssm", PLAIN | estimator_settings(CURVES | fixed)))
    nonlinear = Controller(load_config("ssm", PLAIN), model=curved_model(CURVES))
    first, second = commands_and_plans(curved, 40), commands_and_plans(nonlinear, 40)
    assert first[0] == pytest.approx(second[0], abs=2e-5)
    assert first[1] == pytest.approx(second[1], abs=2e-5)
    flat = commands_and_plans(Controller(load_config("ssm", PLAIN)), 40)
    assert np.abs(first[0] - flat[0]).max() > 0.03


@pytest.mark.parametrize("name", CURVED_SLIPS)
def test_every_setting_reaches_its_entry_of_the_estimate(name):
    settings = estimator_settings({name: 0.011, f"{name}_uncertainty": 0.02})
    controller = Controller(load_config("ssm", PLAIN | settings))
    controller.start(load_trajectory("s"), 0.0)
    slip = controller.step(0.0, Measurement(pose=Stamped(np.zeros(3), 0.0))).estimate
    assert slip.slip == replace(Slip(), **{name: 0.011})
    assert {slip_name for slip_name in SLIPS if getattr(slip.slip_deviation, slip_name) > 0} == {name}
    assert getattr(slip.slip_deviation, name) == pytest.approx(0.02)


def estimate_after_excitation(surface, seed):
    """Return the estimate after the excitation drive of 90 s, without prior knowledge of the surface."""
    drifts = {"longitudinal_gain": 2e-4, "turn_ahead": 1e-3, "turn_left": 1e-3, "side_slip": 2e-3, "yaw_gain": 1.5e-3}
    settings = estimator_settings(
        {f"{name}_drift": drift for name, drift in (drifts | {"load_shift": 3e-4, "v_offset": 3e-3}).items()}
        | {"crab_uncertainty": 0.03, "veer_uncertainty": 0.02, "forward_coupling_uncertainty": 0.03}
        | {"yaw_coupling_uncertainty": 0.1, "longitudinal_gain_uncertainty": 0.02, "side_slip_uncertainty": 0.1}
    )
    reference = time_segments(load_segments("excitation"), TrajectoryLimits.of_robot(), name="excitation")
    return estimate_after(reference, surface, seed, PROMPT | settings)


def estimate_after(reference, surface, seed, settings):
    """Return the estimate at the end of a drive along `reference`."""
    controller, plant = Controller(load_config("ssm", settings)), make_plant("model:ssm", surface, seed=seed)
    plant.reset(reference.sample([0.0]).pose[0])
    controller.start(reference, 0.0)
    while plant.time < reference.duration:
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
    return step.estimate


@pytest.mark.parametrize("surface", ["p4_asphalt", "p4_concrete"])
def test_terms_of_a_surface_are_learned_from_the_excitation_drive(surface):
    """After 90 s, the errors are below 20 % of the published coefficients, or below `tolerance` for small terms."""
    truth = dict(zip(POLYNOMIAL, load_surface(surface).slip.polynomial.coefficients, strict=True))
    learned = dict(zip(POLYNOMIAL, estimate_after_excitation(surface, 3).slip.polynomial, strict=True))
    tolerance = {"a11": 0.001, "a12": 0.001, "a21": 0.001, "a23": 0.003, "a31": 0.0015}
    for name, value in truth.items():
        assert learned[name] == pytest.approx(value, rel=0.2, abs=tolerance.get(name, 0.0)), name


def test_unobservable_terms_keep_their_prior():
    """On one circle at one speed, only the sum of yaw gain, veer and coupling is observable."""
    settings = estimator_settings({"veer_uncertainty": 0.02, "yaw_coupling_uncertainty": 0.1})
    estimate = estimate_after(load_trajectory("circle"), "p4_asphalt", 3, settings)
    slip, deviation = estimate.slip, estimate.slip_deviation
    assert deviation.yaw_coupling > 0.03
    turning = slip.yaw_gain * slip.omega_gain + slip.veer * 1.0 / 1.0 + slip.yaw_coupling * 0.5
    truth = 0.595 + 0.005 + 0.119 * 0.5
    assert turning == pytest.approx(truth, abs=0.05)


SSM = load_model("ssm")


@given(st.tuples(st.floats(0, 0.1), st.floats(0, 0.1)), st.integers(1, 25), st.integers(0, 1000))
def test_prediction_matches_simulation(dead_time, horizon, seed):
    model = SSM.with_extra_dead_time(dead_time).discretise(0.0202)
    prediction = build_prediction(model, horizon)
    rng = np.random.default_rng(seed)
    state, past, plan = rng.normal(size=model.order), rng.normal(size=(model.memory, 2)), rng.normal(size=(horizon, 2))
    predicted = (
        prediction.from_state @ state + prediction.from_past @ past.ravel() + prediction.from_plan @ plan.ravel()
    )
    simulated = model.simulate(np.vstack([plan, plan[-1:]]), state, past)
    assert predicted.reshape(-1, 2) == pytest.approx(simulated, abs=1e-10)
