"""What the oracle aims at: the heading at which the robot travels along its path, and commands that hold a twist."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from diffdrive_mpc.models import VelocityModel, load_model
from diffdrive_mpc.mpc.problem.slip import Slip
from oracle.motion import sideways
from oracle.tick import FeedForward, heading_to_hold

DT = 0.0202
speeds = st.floats(-1.5, 1.5)
rates = st.floats(-2.0, 2.0)
slips = st.floats(0.0, 0.2)
places = st.floats(-0.1, 0.1)


@given(speeds, rates, slips, places)
def test_at_the_heading_to_hold_the_robot_travels_along_the_path(v, omega, side_slip, turn_ahead):
    assume(abs(v) > 0.5)
    slip, path = Slip(side_slip=side_slip, turn_ahead=turn_ahead), np.array([1.0, 2.0, 0.3])
    (heading,) = heading_to_hold(path[None], np.array([[v, omega]]), slip)
    left = sideways(v, omega, side_slip, turn_ahead)
    course = heading + np.arctan(left / v)
    # Exact but for the bend that keeps it finite on the spot: at half a metre a second 4 % of the turning point's part.
    assert course == pytest.approx(0.3, abs=0.04 * abs(turn_ahead * omega / v) + 1e-12)


@given(rates, slips)
def test_side_slip_alone_is_led_exactly_at_any_speed(omega, side_slip):
    for v in (-1.0, 0.01, 0.3):
        (heading,) = heading_to_hold(np.zeros((1, 3)), np.array([[v, omega]]), Slip(side_slip=side_slip))
        assert heading + np.arctan(sideways(v, omega, side_slip, 0.0) / v) == pytest.approx(0.0, abs=1e-12)


@given(speeds, rates)
def test_without_slip_the_heading_of_the_path_is_held(v, omega):
    assert heading_to_hold(np.array([[1.0, 2.0, 0.3]]), np.array([[v, omega]]), Slip()) == pytest.approx(
        [0.3], abs=1e-15
    )


@given(rates, places)
def test_turning_on_the_spot_a_turning_point_is_not_led(omega, turn_ahead):
    """No heading makes up for it; and on the way there the lead stays bounded."""
    twist = np.array([[0.0, omega], [1e-3, omega], [0.1, omega]])
    lead = heading_to_hold(np.zeros((3, 3)), twist, Slip(turn_ahead=turn_ahead))
    assert lead[0] == 0.0
    assert (np.abs(lead) <= np.abs(5 * turn_ahead * omega) + 1e-12).all()


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_the_feed_forward_holds_a_constant_twist_against_slip(name):
    model = load_model(name)
    slip = Slip(v_offset=0.03, omega_gain=0.9, longitudinal_gain=0.97, yaw_gain=0.8, turn_left=0.05)
    feed_forward = FeedForward(model, DT, 10)
    commands = feed_forward.commands(np.tile([0.6, 0.4], (feed_forward.samples, 1)), slip)
    wheels = commands @ model.dc_gain.T * [1.0, 0.9] + [0.03, 0.0]
    v, omega = (wheels * [0.97, 0.8]).T
    assert np.column_stack([v + 0.05 * omega, omega]) == pytest.approx(np.tile([0.6, 0.4], (10, 1)))


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
