"""Monitor next to the node of the root package: independence, namespaces, holds, and a killed monitor."""

import math
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Path as PathMessage
from rclpy.context import Context
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_parts import in_name_space, stack
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_over_dds import BOUND, true_twists
from two_processes import own_domain, running

import diffdrive_mpc_monitor
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs.bag_topics import COMMANDS, TopicRequest, open_bag, read_topics
from diffdrive_mpc.models.logs.mapping import Topic
from diffdrive_mpc_monitor.judge import Judge
from diffdrive_mpc_monitor.ros.node import MonitorNode, MonitorSettings, planar, seconds
from diffdrive_mpc_monitor.rules import load_rules
from imports import imports_of

PACKAGE = Path(diffdrive_mpc_monitor.__file__).parent
SHARED = {
    "checked_yaml",
    "compiled",
    "errors",
    "file_limits",
    "input_file",
    "lazy_names",
    "named_file",
    "suggestions",
    "table",
    "trust",
}
"""Modules of `diffdrive_mpc.models` that the monitor uses: file readers and the C loader, but no control code."""
CONTROL = ("diffdrive_mpc.mpc", "casadi", "mujoco", "osqp", "daqp", "scipy", "control", "matplotlib", "pandas")
PROGRAMS = {
    "judge": "from diffdrive_mpc_monitor.judge import Judge\n"
    "from diffdrive_mpc_monitor.rules import load_rules\n"
    "Judge(load_rules()).command(0.0, 0.0, 1.0, 0.0)\n",
    "process": "import sys\n"
    "from rclpy.executors import SingleThreadedExecutor\n"
    "def end(self, timeout_sec=None): raise KeyboardInterrupt\n"
    "SingleThreadedExecutor.spin_once = end\n"
    "from diffdrive_mpc.app.cli import main\n"
    "sys.argv = ['diffdrive-mpc', 'monitor']\n"
    "try: main()\n"
    "except (SystemExit, KeyboardInterrupt): pass\n",
}


@pytest.mark.parametrize("part", ["judge.py", "rules.py", "senders.py", "ros/node.py"])
def test_modules_import_nothing_of_the_controller(part):
    modules = {module for module, _ in imports_of(PACKAGE / part) if module.startswith("diffdrive_mpc.")}
    assert {module.split(".")[1] for module in modules} <= {"models"}
    assert {module.split(".")[2] for module in modules} <= SHARED


def test_c_sources_include_nothing_of_the_controller():
    headers = set()
    for path in [*PACKAGE.rglob("*.c"), *PACKAGE.rglob("*.h")]:
        headers |= set(re.findall(r'#\s*include\s*[<"]([^>"]+)', path.read_text(encoding="utf-8")))
    assert headers <= {"judge.h", "rules.h", "math.h", "string.h", "stdio.h", "stdint.h", "board.h"}
    assert "ddmpc_" not in (PACKAGE / "core" / "judge.c").read_text(encoding="utf-8")


@pytest.mark.parametrize("program", PROGRAMS)
def test_running_monitor_loads_no_module_of_the_controller(program):
    code = PROGRAMS[program] + "import sys\nprint(*sorted(sys.modules), sep='\\n')\n"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    loaded = set(result.stdout.split())
    assert "diffdrive_mpc_monitor.judge" in loaded
    assert ("diffdrive_mpc_monitor.ros.node" in loaded) == (program == "process"), result.stderr
    assert not [name for name in loaded if name.startswith(CONTROL)]


def test_monitor_uses_the_topics_of_its_namespace():
    context = Context()
    rclpy.init(context=context, args=in_name_space("r2"))
    node = MonitorNode(MonitorSettings(), context=context)
    try:
        topics = {topic for topic, _ in node.get_subscriber_names_and_types_by_node("monitor", "/r2")}
        names = ("cmd_vel_unchecked", "odom", "diffdrive_mpc/reference_path", "diffdrive_mpc/mode")
        assert {f"/r2/{name}" for name in names} <= topics
        assert node._name == "r2/monitor"
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_unknown_parameter_similar_to_a_known_parameter_prevents_the_start():
    parameter, message = "use_pose_topik:=true", "unknown parameter 'use_pose_topik'; did you mean 'use_pose_topic'?"
    context = Context()
    # `gadget` could be a parameter of another node.
    arguments = [parameter, "qos_overrides./clock.subscription.depth:=3", "gadget:=1"]
    rclpy.init(context=context, args=["--ros-args", *(part for argument in arguments for part in ("-p", argument))])
    try:
        with pytest.raises(ConfigError) as refusal:
            MonitorNode(MonitorSettings(), context=context)
    finally:
        rclpy.shutdown(context=context)
    assert message in str(refusal.value) and "\n" not in str(refusal.value)


def test_unknown_parameter_at_run_time_raises_an_error_with_its_name():
    context = Context()
    rclpy.init(context=context, args=in_name_space("r3"))
    node = MonitorNode(MonitorSettings(), context=context)
    try:
        with pytest.raises(ParameterNotDeclaredException, match="unknown parameter 'rulez'; did you mean 'rules'"):
            node.set_parameters_atomically([Parameter("rulez", value="default")])
        assert not node.set_parameters_atomically([Parameter("rules", value="other")]).successful
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


class TopicJudge:
    """Judge that reads the topics of the node, like the process of the monitor."""

    def __init__(self, s):
        self.base, self.paths = s.base, []
        self.judge = Judge(load_rules().with_sensors(pose=False, gyro=False), self.now)
        s.base.tamper = self.take_odometry
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        s.base.node.create_subscription(PathMessage, "/diffdrive_mpc/reference_path", self.take_path, latched)
        s.base.node.create_subscription(String, "/diffdrive_mpc/mode", self.take_mode, latched)

    @property
    def now(self):
        return 1e-9 * self.base.now

    def take_path(self, message):
        self.paths.append([(seconds(point.header.stamp), *planar(point.pose)) for point in message.poses])
        self.judge.reference(self.now, self.paths[-1])

    def take_mode(self, message):
        self.judge.says(self.now, drives=message.data.partition(":")[0] == "TRACKING")

    def take_odometry(self, message):
        twist = message.twist.twist
        pose = planar(message.pose.pose)
        self.judge.odometry(self.now, seconds(message.header.stamp), (twist.linear.x, twist.angular.z), pose)
        return message

    def run(self, ticks):
        for _ in range(ticks):
            self.judge.command(self.now, self.now, *self.base.step())
            self.base.spin()


@pytest.mark.parametrize(("stop", "is_updated"), [("hold", True), ("pause", True), ("pause", False)])
def test_robot_drives_on_after_a_stop_only_with_the_delayed_reference(stop, is_updated, monkeypatch):
    if not is_updated:
        monkeypatch.setattr("diffdrive_mpc.mpc.ros.control_loop._MIN_SHIFT", math.inf)
    with stack(drive=True) as s:

        def hold(*, active):
            assert s.call(SetBool, "/diffdrive_mpc/hold", SetBool.Request(data=active)).success

        watch = TopicJudge(s)
        watch.run(100)
        assert len(watch.paths) == 1
        hold(active=True) if stop == "hold" else s.trigger("pause")
        watch.run(400)
        assert not watch.judge.verdict and len(watch.paths) == 1
        hold(active=False) if stop == "hold" else s.trigger("start")
        watch.run(150)
        assert bool(watch.judge.verdict) is not is_updated
        if is_updated:
            delay = np.array(watch.paths[-1])[:, 0] - np.array(watch.paths[0])[:, 0]
            assert delay == pytest.approx(s.node._controller.planned_delay, abs=0.25) and (delay > 7.0).all()


@pytest.mark.long
def test_base_stops_the_robot_if_the_monitor_is_killed(tmp_path, monkeypatch):
    """The controller continues to send commands that no process forwards, so the timeout of the base applies."""
    environment, bag = own_domain(tmp_path), tmp_path / "bag"
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    in_sim_time = ["--ros-args", "-p", "use_sim_time:=true", "-p", "use_pose_topic:=true"]
    node = ["node", "--drive", *in_sim_time, "-r", "cmd_vel:=cmd_vel_unchecked"]
    # The timeout is long because the monitor would stop commands that a busy machine delays.
    robot = ["sim-robot", "--lock-step", "--answer-timeout", "12", "--record", str(bag)]
    with (
        running("node", node, environment, tmp_path) as controller,
        running("monitor", ["monitor", *in_sim_time], environment, tmp_path) as monitor,
        running("robot", robot, environment, tmp_path) as base,
        true_twists(environment) as read_twists,
    ):
        deadline = time.monotonic() + BOUND
        while read_twists()[0] < 0.3:
            assert all(process.popen.poll() is None for process in (controller, monitor, base))
            assert "STOPPED" not in monitor.output, monitor.output
            assert time.monotonic() < deadline, (controller.output, monitor.output, base.output)
        monitor.popen.kill()
        while np.abs(read_twists()).max() > 0.01:
            assert controller.popen.poll() is None and base.popen.poll() is None
        assert "no command on /cmd_vel for 0.5 s: the robot stops" in base.output
    with open_bag(bag) as reader:
        topics = ("/cmd_vel", "/ground_truth/twist")
        requests = {name: TopicRequest(Topic(topic=name), COMMANDS) for name in topics}
        commands, truth = read_topics(reader, bag, requests).values()
    delays = 1e-9 * (truth.stamped - commands.received[-1])
    assert commands.value[-1, 0] > 0.2
    assert 0.5 < delays[-1] < 1.5
