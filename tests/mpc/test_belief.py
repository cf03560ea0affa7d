"""The belief of the filter: consistency with the estimate, and prediction."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc import Controller, Measurement, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc.problem.slip import SLIPS, Slip

CURVED = {"estimator.crab_uncertainty": 0.03, "estimator.yaw_coupling_uncertainty": 0.1}


def drive(overrides=None, ticks=120, model="ssm"):
    """Return controller, plant and last step after `ticks` ticks on grass."""
    controller, plant = Controller(load_config(model, overrides or {})), make_plant("model:ssm", "p4_grass", seed=5)
    controller.start(load_trajectory("s"), 0.0)
    for _ in range(ticks):
        step = controller.step(plant.time, plant.measure())
        plant.advance(step.command)
    return controller, plant, step


@pytest.mark.parametrize("settings", [{}, CURVED])
@pytest.mark.parametrize("model", ["ssm", "mbm"])
def test_predicted_belief_equals_the_filter_state_without_measurements(settings, model):
    controller, plant, step = drive(settings, model=model)
    start, commands = controller.belief, [step.command]
    for k in range(1, 13):
        step = controller.step(plant.time + (k - 1) * plant.sample_time, Measurement())
        commands.append(step.command)
    end, predicted = controller.belief, controller.predict_belief(start, commands[:-1])
    assert np.array_equal(predicted.mean, end.mean)
    assert np.array_equal(predicted.covariance, end.covariance)
    assert np.array_equal(predicted.sent, end.sent)
    assert np.hypot(*(end.pose - start.pose)[:2]) > 0.02
    assert np.trace(end.pose_covariance) > np.trace(start.pose_covariance)


@pytest.mark.parametrize("settings", [{}, CURVED])
def test_belief_matches_the_estimate(settings):
    controller, _, step = drive(settings)
    belief, estimate = controller.belief, step.estimate
    # The estimate reduces terms without evidence.
    reduced = ["turn_ahead", "turn_left", "slide_x", "slide_y"]
    assert all(abs(getattr(estimate.slip, name)) < abs(getattr(belief.slip, name)) for name in reduced)
    assert abs(estimate.slip.omega_gain - 1.0) < abs(belief.slip.omega_gain - 1.0)
    assert belief.mean == pytest.approx(estimate.mean, abs=0.02)
    assert np.sqrt(np.diag(belief.covariance)) == pytest.approx(estimate.deviation, rel=1e-12)
    assert belief.covariance == pytest.approx(belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance).min() > -1e-12
    assert np.sqrt(np.diag(belief.slip_covariance)) == pytest.approx(astuple(estimate.slip_deviation))
    # Measurements constrain sums of the terms, so the terms are correlated.
    assert np.abs(belief.polynomial_covariance - np.diag(np.diag(belief.polynomial_covariance))).max() > 1e-6


def test_known_slip_reduces_the_pose_covariance():
    """The covariance of unknown slip increases the covariance of the pose; exactly known slip does not."""
    controller, _, _ = drive()
    belief, commands = controller.belief, np.tile([0.5, 0.8], (60, 1))
    covariance, mean = belief.covariance.copy(), belief.mean.copy()
    covariance[belief.slips], covariance[:, belief.slips] = 0.0, 0.0
    known = replace(belief, covariance=covariance)
    uncertain, certain = (controller.predict_belief(start, commands) for start in (belief, known))
    assert np.array_equal(uncertain.mean, certain.mean)
    assert uncertain.pose_covariance[2, 2] > certain.pose_covariance[2, 2]
    # A different slip turns the robot by a different angle.
    mean[belief.slips] = [getattr(Slip(), name) for name in SLIPS[: belief.slips.stop - belief.slips.start]]
    without_slip = controller.predict_belief(replace(known, mean=mean), commands)
    assert abs(without_slip.pose[2] - uncertain.pose[2]) > 0.1


small_offsets = st.lists(st.floats(-0.3, 0.3), min_size=len(SLIPS), max_size=len(SLIPS))


@given(small_offsets, small_offsets)
def test_polynomial_gradient_equals_finite_differences(offset, direction):
    slip = Slip(*(np.array(astuple(Slip())) + offset))
    step = 1e-6 * np.array(direction)
    shifted = Slip(*(np.array(astuple(slip)) + step))
    assert shifted.polynomial - slip.polynomial == pytest.approx(slip.polynomial_gradient @ step, abs=1e-11)


def test_invalid_commands_for_a_prediction_raise_value_error():
    controller, _, _ = drive(ticks=5)
    for commands in ([0.1, 0.2], [[0.1, np.nan]], np.zeros((3, 3))):
        with pytest.raises(ValueError, match="finite pairs"):
            controller.predict_belief(controller.belief, commands)
    assert np.array_equal(controller.predict_belief(controller.belief, np.zeros((0, 2))).mean, controller.belief.mean)
    controller.start(load_trajectory("s"), 0.0)
    with pytest.raises(RuntimeError, match="call step with a pose first"):
        _ = controller.belief
