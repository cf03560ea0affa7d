"""Three robots on one machine, each in a namespace: each follows its own path, and diagnostics name each."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from ros_parts import DT, in_name_space, stack

from diffdrive_mpc import load_trajectory
from diffdrive_mpc.mpc.monitor.ros.node import MonitorNode, MonitorSettings
from diffdrive_mpc.mpc.ros.node import TrackingNode

NODE_YAML = Path(__file__).parents[2] / "ros" / "config" / "node.yaml"
PATHS = {"r1": "circle", "r2": "reverse_slalom", "r3": "cane"}
TICKS = 150


@pytest.fixture(scope="module")
def driven():
    """Three stacks that have been driven in turns, with what each base has heard on /diagnostics."""
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
        said = robots["r1"].listen(DiagnosticArray, "/diagnostics", 100)
        for robot in robots.values():
            assert robot.trigger("start").success
        for _ in range(TICKS):
            for robot in robots.values():
                robot.base.step()
        robots["r1"].base.until(lambda: {status.name for array in said for status in array.status} >= NAMES, "words")
        yield robots, said


NAMES = {f"{name}/diffdrive_mpc: control" for name in PATHS}


@pytest.mark.parametrize("name", PATHS)
def test_each_robot_follows_its_own_path(driven, name):
    robots, _ = driven
    reference = load_trajectory(PATHS[name]).sample([(TICKS - 1) * DT]).pose[0]
    distance = np.hypot(*(robots[name].base.plant.true_pose[:2] - reference[:2]))
    assert distance < 0.05
    others = [load_trajectory(PATHS[other]).sample([(TICKS - 1) * DT]).pose[0] for other in PATHS if other != name]
    assert all(np.hypot(*(reference[:2] - other[:2])) > 0.1 for other in others)


def test_diagnostics_name_each_robot(driven):
    _, said = driven
    statuses = [status for array in said for status in array.status]
    assert {status.name for status in statuses} == NAMES
    assert {status.hardware_id for status in statuses} == {f"{name}/diffdrive_mpc" for name in PATHS}


def test_nobody_sees_a_rival_in_another_namespace(driven):
    robots, _ = driven
    assert all(robot.loop.warning == robot.loop.objection == "" for robot in robots.values())


@pytest.mark.parametrize("name", ["", "r1"])
def test_the_parameter_file_fits_every_namespace(name):
    given = yaml.safe_load(NODE_YAML.read_text())["/**/diffdrive_mpc"]["ros__parameters"]
    context = Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(NODE_YAML), *in_name_space(name)[1:]])
    node = TrackingNode(context=context)
    try:
        assert {key: node.get_parameter(key).value for key in given} == given
        assert node.resolve_topic_name("cmd_vel") == f"/{name}/cmd_vel".replace("//", "/")
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_the_monitor_is_in_the_namespace_of_its_robot():
    context = Context()
    rclpy.init(context=context, args=in_name_space("r2"))
    node = MonitorNode(MonitorSettings(), context=context)
    try:
        topics = {topic for topic, _ in node.get_subscriber_names_and_types_by_node("monitor", "/r2")}
        assert {
            "/r2/cmd_vel_unchecked",
            "/r2/odom",
            "/r2/diffdrive_mpc/reference_path",
            "/r2/diffdrive_mpc/mode",
        } <= topics
        assert node._name == "r2/monitor"
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
