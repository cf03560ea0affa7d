"""Fence: a robot on a path that leaves the rectangle stops inside and waits for a restart."""

import numpy as np
import pytest
from ideal_robot import IdealRobot, drive

from diffdrive_mpc import Controller, load_config, load_model, make_plant, simulate
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import starting_at
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands

DT = 0.0202
SIZE = np.array([2.4, 1.6])
FENCE = {"fence.enabled": True, "fence.length": SIZE[0], "fence.width": SIZE[1], "fence.margin": 0.1}


def leaving_path(v=0.6, omega=0.2, heading=0.0):
    segments = [Segment(v=v, omega=omega, duration=8.0)]
    return time_commands(segments, TrajectoryLimits.of_robot(), name="out", start=(0.0, 0.0, heading))


def distance_outside(poses, centre=(0.0, 0.0, 0.0), size=SIZE):
    """Return the distance of poses (n, 3) outside a rectangle [m]; negative inside."""
    x, y, turn = centre
    position = (poses[:, 0] - x + 1j * (poses[:, 1] - y)) * np.exp(-1j * turn)
    return np.maximum(np.abs(position.real) - size[0] / 2, np.abs(position.imag) - size[1] / 2)


@pytest.mark.parametrize("yaw_gain", [0.5, 1.0, 1.5])
@pytest.mark.parametrize(("v", "omega", "heading"), [(0.6, 0.2, 0.3), (0.9, -0.5, 1.9), (-0.5, 0.4, -0.8)])
def test_robot_stops_inside_the_fence_with_a_wrong_yaw_gain(v, omega, heading, yaw_gain):
    model, reference = load_model("ssm"), leaving_path(v, omega, heading)
    robot = IdealRobot(model.discretise(DT), reference.sample([0.0]).pose[0], slip=Slip(yaw_gain=yaw_gain), noise=1.0)
    controller = Controller(load_config("ssm", {**FENCE, "fence.frame": "poses"}), model)
    steps, poses, _ = drive(controller, robot, reference, 350 * DT)
    distance = distance_outside(poses)
    # The robot stops inside but near the margin, so it does not brake too early.
    assert -0.16 < distance.max() < 0.0
    modes = [step.mode for step in steps]
    assert modes[0] == Mode.TRACKING
    assert modes[-1] == Mode.STOPPED
    assert "leaves the fence of 2.4 by 1.6 m; call start or reset" in steps[-1].message


@pytest.mark.parametrize("extra_dead_time", [0.0, 0.08])
def test_unknown_dead_time_increases_the_stopping_distance_by_its_motion(extra_dead_time):
    controller = Controller(load_config("ssm", FENCE))
    run = simulate(controller, make_plant("model:ssm", seed=1, extra_dead_time=extra_dead_time), leaving_path(0.9, 0.0))
    assert distance_outside(run.true_pose).max() <= 0.9 * extra_dead_time + 0.005 - 0.1
    assert run.modes[-1] == "STOPPED"
    is_braking = np.array(run.modes) == "BRAKING"
    deceleration = np.abs(np.diff(run.command[:, 0], prepend=run.command[0, 0]))[is_braking]
    assert deceleration.max() <= controller.config.limits.v_braking * DT + 1e-9


def test_mujoco_robot_stops_inside_the_fence():
    run = simulate(Controller(load_config("ssm", FENCE)), make_plant("mujoco", seed=3), leaving_path(0.8, 0.5))
    assert distance_outside(run.true_pose).max() < -0.05
    assert run.modes[-1] == "STOPPED"


def test_robot_at_the_fence_waits_for_a_start_and_drives_only_inwards():
    model = load_model("ssm")
    robot = IdealRobot(model.discretise(DT), np.zeros(3), noise=1.0)
    controller = Controller(load_config("ssm", {**FENCE, "fence.frame": "poses"}), model)

    def steps_along(reference, ticks):
        if reference is not None:
            controller.start(reference, robot.time)
        steps = []
        for _ in range(ticks):
            steps.append(controller.step(robot.time, robot.measure()))
            robot.advance(steps[-1].command)
        return steps

    assert steps_along(leaving_path(), 300)[-1].mode == Mode.STOPPED
    stop_pose = robot.pose.copy()
    assert {step.mode for step in steps_along(None, 50)} == {Mode.STOPPED}
    outwards = steps_along(starting_at(leaving_path(), robot.pose), 60)
    assert outwards[-1].mode == Mode.STOPPED
    assert np.hypot(*(robot.pose - stop_pose)[:2]) < 0.04
    inwards = steps_along(starting_at(leaving_path(v=-0.4, omega=0.0), robot.pose), 150)
    assert {step.mode for step in inwards} == {Mode.TRACKING}
    assert distance_outside(np.array([robot.pose]))[0] < -0.5
    # After the robot has driven back inside, the fence is active again.
    assert steps_along(starting_at(leaving_path(), robot.pose), 300)[-1].mode == Mode.STOPPED
    controller.reset()
    assert "fence" not in controller.step(robot.time, robot.measure()).message


@pytest.mark.parametrize("frame", ["start", "poses"])
def test_fence_has_its_configured_pose(frame):
    start = np.array([3.0, -2.0, 1.1])
    reference = starting_at(leaving_path(0.5, 0.0), start)
    relative = np.array([0.6, -0.2, 0.7])
    turn = np.exp(1j * start[2]) * complex(*relative[:2])
    centre = start + [turn.real, turn.imag, relative[2]]
    configured = relative if frame == "start" else centre
    position = {f"fence.{name}": float(value) for name, value in zip(("x", "y", "heading"), configured, strict=True)}
    controller = Controller(load_config("ssm", {**FENCE, **position, "fence.frame": frame}))
    run = simulate(controller, make_plant("model:ssm", seed=2), reference)
    assert run.modes[-1] == "STOPPED"
    assert -0.12 < distance_outside(run.true_pose, centre).max() < -0.08


def test_unreached_or_disabled_fence_changes_no_command():
    reference = leaving_path(0.5, 0.8)
    runs = [
        simulate(Controller(load_config("ssm", changes)), make_plant("mujoco", seed=4), reference)
        for changes in ({}, {"fence.enabled": True, "fence.length": 9.0, "fence.width": 9.0}, {"fence.length": 0.5})
    ]
    assert all(run.modes[-1] == "TRACKING" for run in runs)
    assert all(np.array_equal(runs[0].command, run.command) for run in runs)
