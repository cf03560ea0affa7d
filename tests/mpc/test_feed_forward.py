"""The feed-forward holds the reference's twist in the steady state, slip included, one lag ahead."""

import numpy as np
import pytest
from diffdrive_mpc.mpc.feed_forward import FeedForward

from diffdrive_mpc.models import VelocityModel, load_model
from diffdrive_mpc.mpc.estimation.slip import Slip

DT = 0.0202


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_it_holds_a_constant_twist_against_slip(name):
    model, slip = load_model(name), Slip(v_offset=0.03, omega_gain=0.9, longitudinal_gain=0.97, yaw_gain=0.8)
    feed_forward = FeedForward(model, DT, 10)
    commands = feed_forward.commands(np.tile([0.6, 0.4], (feed_forward.samples, 1)), slip)
    wheels = commands @ model.dc_gain.T * [1.0, 0.9] + [0.03, 0.0]
    assert wheels * [0.97, 0.8] == pytest.approx(np.tile([0.6, 0.4], (10, 1)))


def test_it_answers_one_lag_ahead():
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
