"""The lean into a curve: the best lag in a steady curve, and nothing where nothing slips."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.lean import lean
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from diffdrive_mpc.mpc.config.schema import Weights

speeds = st.floats(-1.5, 1.5)
rates = st.floats(-2.0, 2.0)
slips = st.floats(0.0, 0.2)


@given(speeds, rates, slips, st.floats(0.0, 100.0))
def test_the_lag_is_the_cheapest_one_in_a_steady_curve(v, omega, side_slip, weight):
    assume(abs(v) > 0.05)
    weights = Weights(heading=weight)
    pose = np.array([[1.0, 2.0, 0.3]])
    aim, heading = lean(pose, np.array([[v, omega]]), side_slip, weights)
    lead, curvature = np.arctan(side_slip * omega), omega / v

    def cost(lag):
        return weights.along * lag**2 + weights.heading * (lead - curvature * lag) ** 2

    best = minimize_scalar(cost).x
    assert aim[0, :2] == pytest.approx(pose[0, :2] - best * np.array([np.cos(0.3), np.sin(0.3)]), abs=1e-6)
    assert aim[0, 2] == pytest.approx(0.3 - curvature * best, abs=1e-5)
    assert heading[0] - aim[0, 2] == pytest.approx(lead, abs=1e-12)


@given(speeds, rates)
def test_without_side_slip_the_reference_is_the_aim(v, omega):
    poses = np.array([[1.0, 2.0, 0.3]])
    aim, heading = lean(poses, np.array([[v, omega]]), 0.0, Weights())
    assert aim == pytest.approx(poses, abs=1e-15)
    assert heading == pytest.approx(poses[:, 2], abs=1e-15)


def test_turning_on_the_spot_needs_no_lead():
    poses = np.array([[1.0, 2.0, 0.3]])
    aim, heading = lean(poses, np.array([[0.0, 1.0]]), 0.1, Weights())
    assert heading == pytest.approx([0.3])
    assert aim[:, :2] == pytest.approx(poses[:, :2])
