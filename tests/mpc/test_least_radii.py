"""Minimum radii of commands and of the robot's motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.reentry.options import RobotState
from diffdrive_mpc.mpc.reentry.path_window import PathWindow
from diffdrive_mpc.mpc.reentry.rejoin import rejoin
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.mpc.trajectories.speed_check import describe_tight_turns
from diffdrive_mpc.sim import simulate

DT = 0.0202
KEY = "limits.min_commanded_radius"
HELD_MESSAGE = "the turn radius is limited to limits.min_commanded_radius"


def excess(commands, radius):
    """Return the violation of the radius by commands [m/s]."""
    v, omega = np.abs(np.atleast_2d(commands)).T
    return omega * radius - v


def simulate_drive(config, reference, **plant):
    return simulate(Controller(config), make_plant(**plant), reference)


@st.composite
def paths(draw):
    """Draw paths forwards and backwards, with cusps and stops, up to the sharpest turns of the robot."""
    segments = []
    for _ in range(draw(st.integers(1, 4))):
        v = draw(st.sampled_from([-1.0, 1.0])) * draw(st.floats(0.2, 0.8))
        omega = draw(st.sampled_from([-1.0, 0.0, 1.0])) * draw(st.floats(0.2, 1.4))
        segments.append(Segment(v=v, omega=omega, duration=draw(st.floats(0.5, 1.5))))
    return time_segments(segments, TrajectoryLimits.of_robot(), name="drawn")


@settings(max_examples=40, deadline=None)
@given(
    path=paths(),
    radius=st.floats(0.1, 3.0),
    slew=st.tuples(st.floats(0.3, 3.0), st.floats(0.5, 8.0)),
    braking=st.tuples(st.floats(0.3, 3.0), st.floats(0.5, 8.0)),
    seed=st.integers(0, 2**31),
)
def test_every_command_satisfies_range_slew_and_radius(path, radius, slew, braking, seed):
    """Poses drift, jump and are lost, the robot moves arbitrarily, and a stop is requested during the drive."""
    limits = dict(zip(("v_slew", "omega_slew", "v_braking", "omega_braking"), (*slew, *braking), strict=True))
    overrides = {KEY: radius, "horizon": 12} | {f"limits.{name}": value for name, value in limits.items()}
    controller, random = Controller(load_config("ssm", overrides)), np.random.default_rng(seed)
    controller.start(path, 0.0)
    max_command, last = np.array([controller.config.limits.v, controller.config.limits.omega]), np.zeros(2)
    offset = np.zeros(3)
    for k in range(200):
        t = k * DT
        offset = 0.97 * offset + random.normal(size=3) * [0.02, 0.02, 0.05]
        pose = Stamped(path.sample([t]).pose[0] + offset, t) if random.random() > 0.1 else None
        hold = Hold("asked to stand") if 120 <= k < 130 else None
        step = controller.step(t, Measurement(pose=pose), hold)
        is_braking = step.mode in ("BRAKING", "FINISHED")
        rate = np.array(braking if is_braking else slew)
        assert (np.abs(step.command) <= max_command + 1e-12).all()
        if step.mode != "STOPPED":
            assert (np.abs(step.command - last) <= rate * DT + 1e-9).all()
        # A ramp to zero has priority: it satisfies the radius only if omega can brake fast enough.
        if not is_braking or radius * braking[1] >= braking[0]:
            assert excess(step.command, radius).max() <= max(1e-12, excess(last, radius).max())
        last = step.command


@pytest.mark.parametrize(("foreign", "max_speed"), [((0.0, 1.0), 0.0), ((0.2, 1.0), 0.2), ((-0.3, -1.2), 0.3)])
def test_foreign_tight_turn_ends_at_the_slew_limit_without_acceleration(foreign, max_speed):
    """The yaw rate is reduced; the speed is not raised to satisfy the radius."""
    config = load_config("ssm", {KEY: 2.0, "limits.omega_slew": 2.0})
    reference = time_segments([Segment(v=0.0, omega=0.0, duration=5.0)], TrajectoryLimits.of_robot(), name="rest")
    controller = Controller(config)
    controller.start(reference, 0.0)
    controller.set_applied_commands([foreign])
    previous = np.array(foreign)
    for k in range(40):
        command = controller.step(k * DT, Measurement(pose=Stamped(np.zeros(3), k * DT))).command
        if excess(previous, 2.0) > 0 and excess(command, 2.0) > 1e-9:
            assert abs(command[1]) == pytest.approx(abs(previous[1]) - 2.0 * DT)
        assert abs(command[0]) <= max_speed + 0.02
        previous = command
    assert excess(previous, 2.0) <= 1e-9


def test_robot_cuts_a_tight_curve_and_returns_to_its_path():
    """The reference has a quarter turn of radius 0.5 m; the minimum radius of commands is 0.7 m."""
    reference = time_segments(
        [Segment(v=0.5, omega=0.0, duration=3.0), Segment(v=0.5, omega=1.0, duration=np.pi / 2)]
        + [Segment(v=0.5, omega=0.0, duration=6.0)],
        TrajectoryLimits.of_robot(),
        name="corner",
    )
    config = load_config("ssm", {KEY: 0.7})
    warning = describe_tight_turns(reference, config.limits, config.sample_time)
    assert "for 2.1 s it turns tighter than limits.min_commanded_radius = 0.7, down to 0.5" in warning
    run = simulate_drive(config, reference, name="model:ssm", sensors="perfect")
    assert excess(run.command, 0.7).max() <= 1e-12
    errors = np.hypot(*(run.true_pose - reference.sample(run.time).pose)[:, :2].T)
    messages = np.array([HELD_MESSAGE in message for message in run.messages])
    corner = (run.time > 2.5) & (run.time < 5.5)
    assert errors[corner].max() > 0.03
    assert messages[corner].any() and not messages[run.time < 2.0].any()
    # The reference clock has waited, so the robot returns to the path while the reference is still late.
    x_errors = np.abs(run.true_pose[:, 0] - reference.sample([reference.duration]).pose[0, 0])
    assert x_errors[run.time > 8.0].max() < 0.01
    assert errors[-1] < 0.01
    unlimited = simulate_drive(load_config("ssm"), reference, name="model:ssm", sensors="perfect")
    assert excess(unlimited.command, 0.7).max() > 0.1


@pytest.mark.parametrize("radius", [0.55, 0.65])
def test_cusps_satisfy_the_radius_forwards_and_backwards(radius):
    """A three-point turn with arcs of 0.6 m is unchanged if the radius permits them; otherwise errors stay moderate."""
    reference = load_trajectory("k_turn")
    run = simulate_drive(load_config("ssm", {KEY: radius}), reference, name="mujoco", seed=3)
    assert excess(run.command, radius).max() <= 1e-12
    assert run.command[:, 0].min() < -0.3
    assert run.metrics.completed
    assert run.metrics.position_rmse_m < (0.02 if radius < 0.6 else 0.12)


@pytest.mark.parametrize("name", ["min_commanded_radius", "min_turn_radius"])
def test_radius_can_change_while_driving_but_not_be_enabled(name):
    controller = Controller(load_config("ssm", {f"limits.{name}": 1.5}))
    assert controller.update(limits={name: 1.2}).limits.model_dump()[name] == 1.2
    with pytest.raises(ConfigError, match=f"limits.{name}: this limit can be changed while driving, but it cannot be"):
        Controller(load_config("ssm")).update(limits={name: 1.2})


def with_radius(radius, **overrides):
    return load_config("ssm", {"limits.min_turn_radius": radius} | overrides)


def circle(radius, v=0.5, turn=1.0):
    segment = Segment(v=v, omega=turn * abs(v) / radius, duration=6.0)
    return time_segments([segment], TrajectoryLimits.of_robot(), name="circle")


def drive(config, reference, surface, start=(0.0, 0.0, 0.0), seconds=None):
    """Return true twists (K, 2) of a drive."""
    controller, plant = Controller(config), make_plant("model:ssm", surface, sensors="perfect", seed=2)
    plant.reset(reference.sample([0.0]).pose[0] + start)
    controller.start(reference, 0.0)
    twists = []
    while plant.time < (seconds or reference.duration):
        plant.advance(controller.step(plant.time, plant.measure()).command)
        twists.append(plant.true_twist[[0, 2]])
    return np.array(twists)


@pytest.mark.parametrize(("surface", "radius"), [("p4_asphalt", 1.8), ("p4_concrete", 2.4), ("p4_grass", 1.2)])
@pytest.mark.parametrize(("v", "turn"), [(0.5, 1.0), (-0.5, 1.0), (0.5, -1.0)])
def test_path_with_a_20_percent_larger_radius_satisfies_the_minimum_radius(surface, radius, v, turn):
    """P4's minimum radii on its surfaces; the robot starts next to its path, so that it must turn towards the path."""
    start = (0.0, 0.03 * turn, 0.0)
    twists = drive(with_radius(radius), circle(1.2 * radius, v, turn), surface, start)
    assert excess(twists, radius).max() <= 4e-3
    unlimited = drive(load_config("ssm"), circle(1.2 * radius, v, turn), surface, start)
    assert excess(unlimited, radius).max() > 0.02


def test_plan_from_a_feasible_state_satisfies_the_radius():
    """From standstill, a feasible state, every sample of the plan satisfies |omega| radius <= |v|."""
    radius, reference = 1.0, circle(1.05)
    controller, dt = Controller(with_radius(radius)), 0.0202
    controller.start(reference, 0.0)
    pose = np.array([0.0, 0.04, -0.1])
    step = controller.step(0.0, Measurement(pose=Stamped(pose, 0.0)))
    assert step.mode == "TRACKING" and step.solver.status.startswith("solved")
    assert (controller.problem_inputs()["direction"] == 1.0).all()
    model = load_model("ssm").with_extra_dead_time([0.005, 0.005]).discretise(dt)
    # The turn and the distance between two poses of the plan follow from the mean of two samples of the twist.
    move = np.diff(step.plan, axis=0)
    turns, distance = np.abs(move[:, 2]), np.hypot(move[:, 0], move[:, 1])
    assert model.order == 2
    assert (turns * radius <= distance + 2e-5).all()
    unlimited = Controller(load_config("ssm"))
    unlimited.start(reference, 0.0)
    move = np.diff(unlimited.step(0.0, Measurement(pose=Stamped(pose, 0.0))).plan, axis=0)
    assert (np.abs(move[:, 2]) > np.hypot(move[:, 0], move[:, 1]) + 1e-3).any()


def test_scaled_path_satisfies_the_minimum_radius():
    config = with_radius(2.0)
    reference = scaled_to_robot("s", config, load_model("ssm"))
    twist = reference.sample(np.linspace(0, reference.duration, 500)).twist
    assert excess(twist, 2.0).max() <= 1e-9
    assert excess(twist, 2.0 * 1.25).max() > 0
    Controller(config).start(reference, 0.0)
    with pytest.raises(ConfigError, match="square: it turns on the spot, which limits.min_turn_radius forbids"):
        scaled_to_robot("square", config, load_model("ssm"))


@pytest.mark.parametrize("side", [-0.3, 0.3])
def test_return_path_satisfies_the_minimum_radius(side):
    reference = circle(4.0)
    window = PathWindow.sample_around(reference, 2.0, 4.0, 0.05)
    index = int(np.argmin(np.abs(window.times - 2.0)))
    pose = window.pose[index] + [0.0, side, 0.0]
    for radius in (0.0, 0.8):
        limits = TrajectoryLimits(0.7, 1.5, 0.7, 2.0, min_turn_radius=radius)
        return_path = rejoin(reference, window, index, RobotState(pose, 0.5, 0.125), 2.0, (0.3, 2.0), limits)
        assert return_path is not None
        twist = return_path.connection.sample(np.linspace(0, return_path.connection.duration, 300)).twist
        assert radius == 0.0 or excess(twist, radius).max() <= 0.02
