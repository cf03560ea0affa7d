"""Nodes in separate processes and in namespaces."""

import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from ros_parts import CONFIG, DT, PATIENCE, FakeBase, stack

from diffdrive_mpc import load_trajectory

pytestmark = pytest.mark.system

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


@pytest.fixture
def moving_base(request):
    """Base, and the process that drives it in simulated time; the parameter is the node's `shutdown_time`."""
    arguments = ["-p", "use_sim_time:=true", "-p", "start_at_robot:=false"]
    arguments += ["-p", f"shutdown_time:={getattr(request, 'param', 1.0)}"]
    process = subprocess.Popen(
        [COMMAND, "node", "--drive", "--ros-args", *arguments], stderr=subprocess.PIPE, text=True
    )
    base = FakeBase(lambda: time.sleep(0.001))
    try:
        base.until(lambda: has_moving_command(base, process), "the first command that moves the robot")
        base.run(20)
        yield base, process
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
        base.close()


def has_moving_command(base, process):
    """Run a tick; return True if the last command moves the robot."""
    assert process.poll() is None, process.stderr.read()
    base.silent(1)
    return base.commands and any(base.commands[-1])


def end_with(base, process, *numbers, ticks=True):
    """Send signals and wait for the end of the process; return its commands (n, 2).

    The clock advances if `ticks` is true.
    """
    count = len(base.commands)
    assert any(base.commands[-1])
    process.send_signal(numbers[0])
    for number in numbers[1:]:
        time.sleep(0.3)
        process.send_signal(number)
    while ticks and process.poll() is None:
        count_before = len(base.commands)
        base.advance_clock()
        base.until(lambda: len(base.commands) > count_before or process.poll() is not None, "a command or the end")  # noqa: B023
        base.plant.advance(base.commands[-1])
    base.until(lambda: process.poll() is not None, "the end of the process")
    for _ in range(20):
        base.spin()
    assert base.commands[-1] == (0.0, 0.0)
    assert process.returncode == 0
    return np.array(base.commands[count - 1 :])


@pytest.mark.parametrize("moving_base", [20.0], indirect=True)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_node_brakes_at_its_limits_and_sends_zero_last(moving_base, number):
    commands = end_with(*moving_base, number)
    braking = np.array([CONFIG.limits.v_braking, CONFIG.limits.omega_braking]) * DT
    assert (np.abs(np.diff(commands, axis=0)) <= braking * 1.001).all()
    assert (np.diff(np.abs(commands[:, 0])) <= 1e-9).all()


@pytest.mark.parametrize("moving_base", [0.5], indirect=True)
def test_braking_ends_after_the_shutdown_time_if_the_clock_stops(moving_base):
    start = time.monotonic()
    assert len(end_with(*moving_base, signal.SIGTERM, ticks=False)) == 2
    assert time.monotonic() - start > 0.5


@pytest.mark.parametrize(
    ("moving_base", "numbers"),
    [(1000.0, [signal.SIGINT, signal.SIGTERM]), (0.0, [signal.SIGINT])],
    indirect=["moving_base"],
)
def test_second_signal_or_no_shutdown_time_sends_zero_at_once(moving_base, numbers):
    assert len(end_with(*moving_base, *numbers, ticks=False)) == 2


def test_killed_node_sends_no_command(moving_base):
    """A killed node cannot send a zero command; the base must stop by its timeout."""
    base, process = moving_base
    process.kill()
    process.wait()
    assert base.silent(5) == 0


NODE_YAML = Path(__file__).parents[2] / "ros" / "config" / "node.yaml"
PATHS = {"r1": "circle", "r2": "reverse_slalom", "r3": "cane"}
TICKS = 150


NAMES = {f"{name}/diffdrive_mpc: control" for name in PATHS}


@pytest.fixture(scope="module")
def alternating_drives():
    """Distances to the references, received diagnostics, and control loops of three stacks that run alternately.

    The stacks run until diagnostics of all nodes have arrived at any base, because Fast DDS may permanently lose a
    topic between two participants.
    """
    with ExitStack() as open_stacks:
        robots = {
            name: open_stacks.enter_context(
                stack(
                    files=[NODE_YAML],
                    name_space=name,
                    trajectory=path,
                    odom_frame=f"{name}/odom",
                    base_frame=f"{name}/base_link",
                    diagnostics_rate=20.0,
                )
            )
            for name, path in PATHS.items()
        }
        received = [robot.listen(DiagnosticArray, "/diagnostics", 100) for robot in robots.values()]
        for robot in robots.values():
            assert robot.trigger("start").success
        run_alternately(robots)
        distances = {name: distance_to_reference(robot, name) for name, robot in robots.items()}
        statuses = [status for arrays in received for array in arrays for status in array.status]
        deadline = time.monotonic() + PATIENCE
        while {status.name for status in statuses} < NAMES:
            assert time.monotonic() < deadline, f"received only {sorted({status.name for status in statuses})}"
            run_alternately(robots, 1)
            statuses = [status for arrays in received for array in arrays for status in array.status]
        yield distances, statuses, [robot.loop for robot in robots.values()]


def run_alternately(robots, ticks=TICKS):
    for _ in range(ticks):
        for robot in robots.values():
            robot.base.step()


def reference_at_end(name):
    return load_trajectory(PATHS[name]).sample([(TICKS - 1) * DT]).pose[0]


def distance_to_reference(robot, name):
    return np.hypot(*(robot.base.plant.true_pose[:2] - reference_at_end(name)[:2]))


@pytest.mark.parametrize("name", PATHS)
def test_each_robot_follows_its_own_path(alternating_drives, name):
    distances, _, _ = alternating_drives
    assert distances[name] < 0.05
    other_ends = [reference_at_end(robot) for robot in PATHS if robot != name]
    assert all(np.hypot(*(reference_at_end(name)[:2] - end[:2])) > 0.1 for end in other_ends)


def test_diagnostics_contain_the_name_of_each_robot(alternating_drives):
    _, statuses, _ = alternating_drives
    assert {status.name for status in statuses} == NAMES
    assert {status.hardware_id for status in statuses} == {f"{name}/diffdrive_mpc" for name in PATHS}


def test_robots_of_other_namespaces_are_not_reported(alternating_drives):
    _, _, loops = alternating_drives
    assert all(loop.warning == loop.stop_reason == "" for loop in loops)
