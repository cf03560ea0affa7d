"""Wheel and body kinematics: inverse of each other, with the signs of a robot that turns left."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models import WheelKinematics
from diffdrive_mpc.models.robot import load_robot

ROBOT = load_robot()
KINEMATICS = WheelKinematics(ROBOT.wheel_radius, ROBOT.track)
twists = st.tuples(st.floats(-1.5, 1.5), st.floats(-2, 2))


@given(twists)
def test_there_and_back(twist):
    assert KINEMATICS.twist(KINEMATICS.wheel_speeds(twist)) == pytest.approx(twist, abs=1e-12)


@given(twists)
def test_pulses_per_second_follow_the_papers_equation(twist):
    v, omega = twist
    factor = ROBOT.encoder_pulses / (2 * np.pi * ROBOT.wheel_radius)
    left, right = factor * (v - omega * ROBOT.track / 2), factor * (v + omega * ROBOT.track / 2)
    pulses = KINEMATICS.wheel_speeds(twist) * ROBOT.encoder_pulses / (2 * np.pi)
    assert pulses == pytest.approx([left, right, left, right], abs=1e-9)


def test_full_speed_is_that_of_the_motor_catalogue():
    assert ROBOT.limits.wheel_speed * ROBOT.wheel_radius == pytest.approx(2.205, abs=1e-3)
    assert ROBOT.limits.wheel_speed * ROBOT.encoder_pulses / (2 * np.pi) == pytest.approx(2796, abs=1)


def test_many_twists_at_once():
    assert KINEMATICS.wheel_speeds(np.zeros((7, 2))).shape == (7, 4)
    assert KINEMATICS.twist(np.ones((7, 4))).shape == (7, 2)


@pytest.mark.parametrize("bad", [0.0, -0.1, float("nan")])
def test_lengths_must_be_lengths(bad):
    with pytest.raises(ValueError, match="radius"):
        WheelKinematics(bad, 0.33)
    with pytest.raises(ValueError, match="track"):
        WheelKinematics(0.07, bad)
