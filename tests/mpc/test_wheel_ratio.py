"""A model made in Python is of an unknown robot: how far it turns is learned whatever `wheels` states."""

import control
import numpy as np
import pytest

from diffdrive_mpc import Controller, VelocityModel, load_trajectory, simulate
from diffdrive_mpc.sim import make_plant

LAG = 0.18


@pytest.fixture(scope="module")
def model():
    systems = control.tf([1.0], [LAG, 1.0]), control.tf([0.62], [LAG, 1.0])
    return VelocityModel.from_control(systems, dead_time=0.13, name="own")


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_yaw_gain_is_known_after_two_seconds_of_turning(model, factor):
    """The plant turns as its model says; encoders of twice or half the track it would be."""
    wheels = {"track": 0.33 * 0.62 * factor, "encoder_track": 0.33}
    controller = Controller({"wheels": wheels, "extra_dead_time": {"v": 0.0, "omega": 0.0}}, model=model)
    step, gains = controller.step, []

    def noted(*measured, **options):
        result = step(*measured, **options)
        gains.append(result.estimate.slip.omega_gain * result.estimate.slip.yaw_gain)
        return result

    controller.step = noted
    run = simulate(controller, make_plant(model, surface="ideal", sensors="perfect"), load_trajectory("circle"))
    turning = np.flatnonzero(np.abs(run.true_twist[:, 2]) > 0.05)[0]
    known = turning + round(2.0 / run.sample_time)
    assert np.abs(np.array(gains)[known:] - 1.0).max() < 0.02
    assert np.abs(run.errors.lateral[known:]).max() < 0.002
