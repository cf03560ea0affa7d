"""Rivals for the same base over DDS: reject, brake or report."""

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import Empty

from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.step_result import Mode

pytestmark = pytest.mark.system

SLEW = np.array([CONFIG.limits.v_slew, CONFIG.limits.omega_slew]) * DT + 1e-9


class Second:
    """Second node of this project, in a separate context."""

    def __init__(self, name="diffdrive_mpc", commands="cmd_vel"):
        words = ["--ros-args", "-r", f"__node:={name}", "-r", f"cmd_vel:={commands}", "-p", "use_sim_time:=true"]
        words += ["--log-level", "error", "-p", "discovery_wait:=8.0"]
        self.context = Context()
        rclpy.init(context=self.context, args=words)
        self.node = TrackingNode(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def activate(self):
        self.node.trigger_configure()
        return self.node.trigger_activate()

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.mark.parametrize("name", ["diffdrive_mpc", "other"])
def test_second_node_on_the_same_topic_is_not_activated(name):
    with stack(drive=True) as s:
        s.base.run(20)
        second = Second(name)
        try:
            assert second.activate() is not rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
            assert "/diffdrive_mpc of this project drives by /cmd_vel too" in second.node.failure
            # The first drives on, and what it hears of the second, that is not active, is no more than a name.
            s.base.until(lambda: s.loop.warning, "the second's publisher")
            s.base.run(20)
            assert s.loop.last.mode == Mode.TRACKING
            assert f"/{name} publishes on /cmd_vel too" in s.loop.warning
            # Once the first is gone the second may.
            s.call(
                ChangeState,
                "/diffdrive_mpc/change_state",
                ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE)),
            ) if name != "diffdrive_mpc" else s.node.trigger_deactivate()
            s.base.until(lambda: not second.node.parts["rivals"].rivals.others().project, "the end of the claim")
            assert second.node.trigger_activate() is rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
        finally:
            second.close()


def test_rival_found_while_driving_brakes_the_robot_until_it_leaves():
    """Discovery is slower than both nodes: another participant claims the topic during the drive."""
    with stack(drive=True) as s:
        before = s.base.run(40)
        claim = s.base.node.create_publisher(Empty, "/cmd_vel/_diffdrive_mpc", 1)
        s.base.until(lambda: s.loop.objection, "the objection")
        braking = s.base.run(60)
        assert not braking[-1].any()
        assert (np.abs(np.diff(np.vstack([before, braking]), axis=0)) <= SLEW).all()
        assert "/fake_base of this project drives by /cmd_vel too" in s.loop.last.message
        assert not s.trigger("reset").message.startswith("pause")
        response = s.trigger("start")
        assert not response.success
        s.base.node.destroy_publisher(claim)
        s.base.until(lambda: not s.loop.objection, "the end of it")
        s.base.run(2)
        assert s.trigger("start").success
        assert s.base.run(30)[-1, 0] > 0.1


def test_second_publisher_on_an_input_stops_the_robot_until_it_leaves():
    with stack(drive=True) as s:
        before = s.base.run(40)
        forger = rclpy.create_node("forger", context=s.base.context)
        odometry = forger.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        s.base.until(lambda: s.loop.objection, "the objection")
        assert s.loop.objection.startswith("/fake_base and /forger publish on /odom, and it is not known which")
        braking = s.base.run(60)
        assert not braking[-1].any()
        assert (np.abs(np.diff(np.vstack([before, braking]), axis=0)) <= SLEW).all()
        forger.destroy_publisher(odometry)
        s.base.until(lambda: not s.loop.objection, "the end of it")
        forger.destroy_node()
        # It stood for longer than failure.resume_within.
        assert not s.base.run(20).any()
        assert s.trigger("resume").success
        assert s.base.run(40)[-1, 0] > 0.1


def test_teleop_publisher_is_reported_while_the_robot_drives_on():
    with stack(drive=True, diagnostics_rate=20.0) as s:
        heard = s.listen(DiagnosticArray, "/diagnostics")
        s.base.run(20)
        teleop = s.base.node.create_publisher(TwistStamped, "cmd_vel", 1)
        s.base.until(lambda: s.loop.warning, "the warning")
        assert s.loop.warning == "/fake_base publishes on /cmd_vel too"
        assert s.base.run(20)[-1, 0] > 0.1
        s.base.until(lambda: heard and "publishes on" in heard[-1].status[0].message, "diagnostics")
        assert heard[-1].status[0].level == DiagnosticStatus.WARN
        s.base.node.destroy_publisher(teleop)
        s.base.until(lambda: not s.loop.warning, "the end of it")


@pytest.mark.parametrize(("stamped", "command_type", "remedy"), [(True, Twist, "false"), (False, TwistStamped, "true")])
def test_base_with_another_command_type_is_reported_with_the_remedy(stamped, command_type, remedy):
    with stack(stamped=stamped) as s:
        context = Context()
        rclpy.init(context=context, args=[])
        deaf = rclpy.create_node("deaf_base", context=context)
        deaf.create_subscription(command_type, "cmd_vel", lambda _: None, 1)
        s.base.until(lambda: "/deaf_base" in s.loop.warning, "the warning")
        assert s.loop.warning.startswith(f"/deaf_base subscribes to /cmd_vel with type {command_type.__name__} and")
        assert s.loop.warning.endswith(f"set the parameter stamped:={remedy}")
        deaf.destroy_node()
        rclpy.shutdown(context=context)
        s.base.until(lambda: not s.loop.warning, "the end of it")


def test_exclusive_cmd_vel_brakes_for_a_teleop_and_rejects_activation():
    with stack(drive=True, exclusive_cmd_vel=True, diagnostics_rate=20.0) as s:
        heard = s.listen(DiagnosticArray, "/diagnostics")
        s.base.run(20)
        teleop = s.base.node.create_publisher(TwistStamped, "cmd_vel", 1)
        s.base.until(lambda: s.loop.objection, "the objection")
        assert not s.base.run(60)[-1].any()
        assert "or set exclusive_cmd_vel to false" in s.loop.last.message
        heard.clear()
        s.base.until(lambda: heard and heard[-1].status[0].level == DiagnosticStatus.ERROR, "diagnostics")
        s.node.trigger_deactivate()
        assert s.node.trigger_activate() is not rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
        assert "/fake_base publishes on /cmd_vel too" in s.node.failure
        s.base.node.destroy_publisher(teleop)
        s.base.until(lambda: not s.node.parts["rivals"].rivals.others().foreign, "its end")
        assert s.node.trigger_activate() is rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
