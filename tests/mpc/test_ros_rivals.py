"""Competing publishers of commands over DDS: reject, brake or report."""

from contextlib import contextmanager

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from lifecycle_msgs.msg import Transition
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from ros_parts import stack

from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.step_result import Mode

pytestmark = pytest.mark.system


@contextmanager
def second_node(name):
    """Yield a second node of this project, configured and in a separate context."""
    arguments = ["--ros-args", "-r", f"__node:={name}", "-p", "use_sim_time:=true"]
    context = Context()
    rclpy.init(context=context, args=[*arguments, "--log-level", "error", "-p", "discovery_wait:=8.0"])
    node = TrackingNode(context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        node.trigger_configure()
        yield node
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize("name", ["diffdrive_mpc", "other"])
def test_second_node_on_the_same_topic_is_not_activated(name):
    with stack(drive=True) as s:
        s.base.run(20)
        with second_node(name) as second:
            assert second.trigger_activate() is not rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
            assert "/diffdrive_mpc of this project also sends commands on /cmd_vel" in second.failure
            # The first node keeps driving and reports the name of the inactive second node.
            s.base.until(lambda: s.loop.warning, "the warning about the second publisher")
            s.base.run(20)
            assert s.loop.last.mode == Mode.TRACKING
            assert f"/{name} also publishes on /cmd_vel" in s.loop.warning
            # The second node can be activated after the first is deactivated.
            if name == "diffdrive_mpc":
                s.node.trigger_deactivate()
            else:
                s.change(Transition.TRANSITION_DEACTIVATE)
            rivals = second.parts["rivals"].rivals
            s.base.until(lambda: not rivals.others().project, "the end of the claim of the first node")
            assert second.trigger_activate() is rclpy.lifecycle.TransitionCallbackReturn.SUCCESS


@pytest.mark.parametrize(("stamped", "command_type", "remedy"), [(True, Twist, "false"), (False, TwistStamped, "true")])
def test_base_with_another_command_type_is_reported_with_the_remedy(stamped, command_type, remedy):
    with stack(stamped=stamped) as s:
        context = Context()
        rclpy.init(context=context, args=[])
        mismatched = rclpy.create_node("mismatched_base", context=context)
        mismatched.create_subscription(command_type, "cmd_vel", lambda _: None, 1)
        s.base.until(lambda: "/mismatched_base" in s.loop.warning, "the warning")
        assert s.loop.warning.startswith(
            f"/mismatched_base subscribes to /cmd_vel with type {command_type.__name__} and"
        )
        assert s.loop.warning.endswith(f"set the parameter stamped:={remedy}")
        mismatched.destroy_node()
        rclpy.shutdown(context=context)
        s.base.until(lambda: not s.loop.warning, "the end of the warning")


def test_exclusive_cmd_vel_brakes_for_a_teleop_and_rejects_activation():
    with stack(drive=True, exclusive_cmd_vel=True, diagnostics_rate=20.0) as s:
        received = s.listen(DiagnosticArray, "/diagnostics")
        s.base.run(20)
        teleop = s.base.node.create_publisher(TwistStamped, "cmd_vel", 1)
        s.base.until(lambda: s.loop.stop_reason, "the reason")
        assert not s.base.run(60)[-1].any()
        assert "or set exclusive_cmd_vel to false" in s.loop.last.message
        received.clear()
        s.base.until(lambda: received and received[-1].status[0].level == DiagnosticStatus.ERROR, "diagnostics")
        s.node.trigger_deactivate()
        assert s.node.trigger_activate() is not rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
        assert "/fake_base also publishes on /cmd_vel" in s.node.failure
        s.base.node.destroy_publisher(teleop)
        s.base.until(lambda: not s.node.parts["rivals"].rivals.others().foreign, "the end of the foreign publisher")
        assert s.node.trigger_activate() is rclpy.lifecycle.TransitionCallbackReturn.SUCCESS
