"""What the oracle aims at: the best lag in a steady curve against side-slip, and commands that hold a twist."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from diffdrive_mpc.models import VelocityModel, load_model
from diffdrive_mpc.mpc.config.schema import Weights
from diffdrive_mpc.mpc.estimation.slip import Slip
from oracle.tick import FeedForward, lean

DT = 0.0202
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


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_the_feed_forward_holds_a_constant_twist_against_slip(name):
    model, slip = load_model(name), Slip(v_offset=0.03, omega_gain=0.9, longitudinal_gain=0.97, yaw_gain=0.8)
    feed_forward = FeedForward(model, DT, 10)
    commands = feed_forward.commands(np.tile([0.6, 0.4], (feed_forward.samples, 1)), slip)
    wheels = commands @ model.dc_gain.T * [1.0, 0.9] + [0.03, 0.0]
    assert wheels * [0.97, 0.8] == pytest.approx(np.tile([0.6, 0.4], (10, 1)))


def test_the_feed_forward_answers_one_lag_ahead():
    model = load_model("ssm")
    feed_forward = FeedForward(model, DT, 10)
    ramp = np.outer(np.arange(feed_forward.samples) * DT, [1.0, 1.0])
    twist = feed_forward.commands(ramp, Slip()) @ model.dc_gain.T
    assert twist == pytest.approx(np.arange(10)[:, None] * DT + model.lag, abs=1e-9)


def test_a_model_that_leads_is_answered_now():
    """A zero near the origin gives a negative lag; there is no twist before now."""
    # v: (1 + 0.4 s) / ((1 + s / 5) (1 + s / 6)), by partial fractions.
    A, B = np.diag([-5.0, -6.0, -10.0]), np.array([[-30.0, 0.0], [42.0, 0.0], [0.0, 10.0]])
    model = VelocityModel("leading", "ssm", A, B, np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert model.lag[0] < 0
    feed_forward = FeedForward(model, DT, 5)
    twist = np.column_stack([np.arange(feed_forward.samples, dtype=float), np.zeros(feed_forward.samples)])
    wanted = feed_forward.commands(twist, Slip()) @ model.dc_gain.T
    assert wanted[:, 0] == pytest.approx(np.arange(5))
