"""The filter learns delays that the model lacks, and the controller uses them."""

from dataclasses import replace

import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot, drive

from diffdrive_mpc import Controller, load_config, load_model
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments

DT = 0.0202
SM = load_model("sm")
BENDS = lay_segments(
    [Segment(v=v, omega=omega, duration=1.0) for v, omega in [(0.5, 0.8), (0.3, -0.8)] * 12],
    TrajectoryLimits.of_robot(),
    name="bends",
)


def driven(late, **settings):
    """Drive a robot that is `late` [s] later than SM; return the controller and the RMSE of the last 4 s [m]."""
    controller = Controller(load_config("sm", PROMPT | settings))
    robot = replace(SM, dead_time=SM.dead_time + late).discretise(DT)
    plant = IdealRobot(robot, BENDS.sample([0.0]).pose[0], noise=1.0)
    _, poses, times = drive(controller, plant, BENDS, 16.0)
    errors = (poses - BENDS.sample(times).pose)[round(-4.0 / DT) :, :2]
    return controller, np.sqrt(np.mean(np.sum(errors**2, axis=1)))


@pytest.mark.parametrize("late", [(0.06, 0.06), (0.09, 0.03), (0.0, 0.0)])
def test_unknown_delays_are_estimated(late):
    controller, _ = driven(late)
    np.testing.assert_allclose(controller.belief.mean[-5:-3], late, atol=0.01)


def test_learned_delays_halve_the_tracking_error():
    learned = driven((0.06, 0.06))[1]
    unknown = driven((0.06, 0.06), **{"compensation.delay": False})[1]
    assert learned < 0.5 * unknown
