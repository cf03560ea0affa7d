"""A robot that must not turn tighter than a radius: in the plan, in references, and on the way back."""

import numpy as np
import pytest

from diffdrive_mpc import (
    ConfigError,
    Controller,
    Measurement,
    Stamped,
    load_config,
    load_model,
    load_trajectory,
    make_plant,
)
from diffdrive_mpc.mpc.reentry.options import Course
from diffdrive_mpc.mpc.reentry.path_window import PathWindow
from diffdrive_mpc.mpc.reentry.way_back import rejoin
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments


def with_radius(radius, **more):
    return load_config("ssm", {"limits.min_turn_radius": radius} | more)


def circle(radius, v=0.5, turn=1.0):
    segment = Segment(v=v, omega=turn * abs(v) / radius, duration=6.0)
    return lay_segments([segment], TrajectoryLimits.of_robot(), name="circle")


def drive(config, reference, surface, start=(0.0, 0.0, 0.0), seconds=None):
    """True twists (K, 2), and those at the end of the first step of each plan."""
    controller, plant = Controller(config), make_plant("model:ssm", surface, sensors="perfect", seed=2)
    plant.reset(reference.sample([0.0]).pose[0] + start)
    controller.start(reference, 0.0)
    twists = []
    while plant.time < (seconds or reference.duration):
        plant.advance(controller.step(plant.time, plant.measure()).command)
        twists.append(plant.true_twist[[0, 2]])
    return np.array(twists)


def excess(twists, radius):
    """By how much each twist turns tighter than allowed [m/s]."""
    return np.abs(twists[:, 1]) * radius - np.abs(twists[:, 0])


@pytest.mark.parametrize(("surface", "radius"), [("p4_asphalt", 1.8), ("p4_concrete", 2.4), ("p4_grass", 1.2)])
@pytest.mark.parametrize(("v", "turn"), [(0.5, 1.0), (-0.5, 1.0), (0.5, -1.0)])
def test_a_path_of_a_radius_that_is_a_fifth_wider_is_driven_without_violation(surface, radius, v, turn):
    """P4's least radii on its floors; the robot begins beside its path, so that it would like to turn in."""
    beside = (0.0, 0.03 * turn, 0.0)
    twists = drive(with_radius(radius), circle(1.2 * radius, v, turn), surface, beside)
    assert excess(twists, radius).max() <= 4e-3
    free = drive(load_config("ssm"), circle(1.2 * radius, v, turn), surface, beside)
    assert excess(free, radius).max() > 0.02


def test_the_plan_keeps_the_radius_wherever_it_can():
    """From a state that allows it, every sample of the plan does: |omega| radius <= |v|, from standstill on."""
    radius, reference = 1.0, circle(1.05)
    controller, dt = Controller(with_radius(radius)), 0.0202
    controller.start(reference, 0.0)
    pose = np.array([0.0, 0.04, -0.1])
    step = controller.step(0.0, Measurement(pose=Stamped(pose, 0.0)))
    assert step.mode == "TRACKING"
    assert step.solver.status.startswith("solved")
    model = load_model("ssm").with_extra_dead_time([0.005, 0.005]).discretise(dt)
    # The plan's turn and way between its poses: the mean of two samples of the twist.
    move = np.diff(step.plan, axis=0)
    turned, way = np.abs(move[:, 2]), np.hypot(move[:, 0], move[:, 1])
    assert model.order == 2
    assert (turned * radius <= way + 2e-5).all()
    free = Controller(load_config("ssm"))
    free.start(reference, 0.0)
    move = np.diff(free.step(0.0, Measurement(pose=Stamped(pose, 0.0))).plan, axis=0)
    assert (np.abs(move[:, 2]) > np.hypot(move[:, 0], move[:, 1]) + 1e-3).any()


@pytest.mark.parametrize("name", ["square", "figure8"])
def test_a_reference_that_turns_tighter_is_refused_in_one_line(name):
    controller = Controller(with_radius(1.5))
    with pytest.raises(ValueError, match=r"turns on a radius of .* tighter than limits.min_turn_radius = 1.5"):
        controller.start(load_trajectory(name), 0.0)


def test_a_scaled_path_is_as_wide_as_the_robot_needs():
    config = with_radius(2.0)
    reference = scaled_to_robot("s", config, load_model("ssm"))
    twist = reference.sample(np.linspace(0, reference.duration, 500)).twist
    assert excess(twist, 2.0).max() <= 1e-9
    assert excess(twist, 2.0 * 1.25).max() > 0
    Controller(config).start(reference, 0.0)
    with pytest.raises(ConfigError, match="square: it turns on the spot, which limits.min_turn_radius forbids"):
        scaled_to_robot("square", config, load_model("ssm"))


@pytest.mark.parametrize("side", [-0.3, 0.3])
def test_the_way_back_turns_no_tighter(side):
    reference = circle(4.0)
    window = PathWindow.around(reference, 2.0, 4.0, 0.05)
    here = int(np.argmin(np.abs(window.times - 2.0)))
    pose = window.pose[here] + [0.0, side, 0.0]
    for radius in (0.0, 0.8):
        limits = TrajectoryLimits(0.7, 1.5, 0.7, 2.0, min_turn_radius=radius)
        found = rejoin(reference, window, here, Course(pose, 0.5, 0.125), 2.0, (0.3, 2.0), limits)
        assert found is not None
        twist = found.connection.sample(np.linspace(0, found.connection.duration, 300)).twist
        assert radius == 0.0 or excess(twist, radius).max() <= 0.02
