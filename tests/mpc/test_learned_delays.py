"""Delays that the model does not contain: estimation and use by the controller."""

from dataclasses import replace

import control
import numpy as np
import pytest
from ideal_robot import PROMPT, IdealRobot, drive

from diffdrive_mpc import Controller, VelocityModel, load_config, load_model, load_trajectory, simulate
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.sim import make_plant

DT = 0.0202
SM = load_model("sm")
BENDS = time_segments(
    [Segment(v=v, omega=omega, duration=1.0) for v, omega in [(0.5, 0.8), (0.3, -0.8)] * 12],
    TrajectoryLimits.of_robot(),
    name="bends",
)


def drive_late_robot(delays, **settings):
    """Drive a robot with additional `delays` (2,) [s]; return the controller and the RMSE of the last 4 s [m]."""
    controller = Controller(load_config("sm", PROMPT | settings))
    robot = replace(SM, dead_time=SM.dead_time + delays).discretise(DT)
    plant = IdealRobot(robot, BENDS.sample([0.0]).pose[0], noise=1.0)
    _, poses, times = drive(controller, plant, BENDS, 16.0)
    errors = (poses - BENDS.sample(times).pose)[round(-4.0 / DT) :, :2]
    return controller, np.sqrt(np.mean(np.sum(errors**2, axis=1)))


@pytest.mark.parametrize("delays", [(0.06, 0.06), (0.09, 0.03), (0.0, 0.0)])
def test_unknown_delays_are_estimated(delays):
    controller, _ = drive_late_robot(delays)
    np.testing.assert_allclose(controller.belief.mean[-5:-3], delays, atol=0.01)


def test_learned_delays_halve_the_tracking_error():
    with_delays = drive_late_robot((0.06, 0.06))[1]
    without_delays = drive_late_robot((0.06, 0.06), **{"compensation.delay": False})[1]
    assert with_delays < 0.5 * without_delays


# The yaw gain of a model without provenance is estimated without prior knowledge from `wheels`.


LAG = 0.18


@pytest.fixture(scope="module")
def model():
    systems = control.tf([1.0], [LAG, 1.0]), control.tf([0.62], [LAG, 1.0])
    return VelocityModel.from_control(systems, dead_time=0.13, name="own")


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_yaw_gain_is_known_after_two_seconds_of_turning(model, factor):
    """The plant equals its model; the encoders assume half of the track, the track, or twice the track."""
    wheels = {"track": 0.33 * 0.62 * factor, "encoder_track": 0.33}
    controller = Controller({"wheels": wheels, "extra_dead_time": {"v": 0.0, "omega": 0.0}}, model=model)
    step, gains = controller.step, []

    def recording_step(*arguments, **options):
        result = step(*arguments, **options)
        gains.append(result.estimate.slip.omega_gain * result.estimate.slip.yaw_gain)
        return result

    controller.step = recording_step
    run = simulate(controller, make_plant(model, surface="ideal", sensors="perfect"), load_trajectory("circle"))
    start = np.flatnonzero(np.abs(run.true_twist[:, 2]) > 0.05)[0]
    converged = start + round(2.0 / run.sample_time)
    assert np.abs(np.array(gains)[converged:] - 1.0).max() < 0.02
    assert np.abs(run.errors.lateral[converged:]).max() < 0.002
