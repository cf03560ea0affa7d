"""The feed-forward holds the reference's twist in the steady state, offset included, one lag ahead."""

import numpy as np
import pytest

from models import VelocityModel, load_model
from mpc.feed_forward import FeedForward

DT = 0.0202


@pytest.mark.parametrize("name", ["ssm", "sm", "mbm"])
def test_it_holds_a_constant_twist_against_an_offset(name):
    model = load_model(name)
    feed_forward, offset = FeedForward(model, DT, 10), np.array([0.03, -0.07])
    commands = feed_forward.commands(np.tile([0.6, 0.4], (feed_forward.samples, 1)), offset)
    assert commands @ model.dc_gain.T + offset == pytest.approx(np.tile([0.6, 0.4], (10, 1)))


def test_it_answers_one_lag_ahead():
    model = load_model("ssm")
    feed_forward = FeedForward(model, DT, 10)
    ramp = np.outer(np.arange(feed_forward.samples) * DT, [1.0, 1.0])
    twist = feed_forward.commands(ramp, np.zeros(2)) @ model.dc_gain.T
    assert twist == pytest.approx(np.arange(10)[:, None] * DT + model.lag, abs=1e-9)


def test_a_model_that_leads_is_answered_now():
    """A zero near the origin gives a negative lag; there is no twist before now."""
    # v: (1 + 0.4 s) / ((1 + s / 5) (1 + s / 6)), by partial fractions.
    A, B = np.diag([-5.0, -6.0, -10.0]), np.array([[-30.0, 0.0], [42.0, 0.0], [0.0, 10.0]])
    model = VelocityModel("leading", "ssm", A, B, np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert model.lag[0] < 0
    feed_forward = FeedForward(model, DT, 5)
    twist = np.column_stack([np.arange(feed_forward.samples, dtype=float), np.zeros(feed_forward.samples)])
    wanted = feed_forward.commands(twist, np.zeros(2)) @ model.dc_gain.T
    assert wanted[:, 0] == pytest.approx(np.arange(5))
