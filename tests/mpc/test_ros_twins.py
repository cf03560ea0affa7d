"""Publishers with equal node names over DDS."""

from contextlib import contextmanager

import pytest
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from ros_parts import stack
from sensor_driver import KINDS, driver, message_of

from diffdrive_mpc.mpc.ros.conversions import time_message

INPUTS = list(KINDS)
SHARED = "two publishers of /fake_base publish on /{}, and their messages cannot be distinguished; stop all but one"


@contextmanager
def twin_of(kind, topic, name="fake_base"):
    """Yield a publisher of a second node with the name of the base, in the thread of the test."""
    context = Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node(name, context=context)
    try:
        yield node.create_publisher(kind, topic, qos_profile_sensor_data)
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.system
@pytest.mark.parametrize("topic", INPUTS)
def test_activation_with_two_drivers_of_equal_names_is_rejected(topic):
    with (
        stack(autostart=False, sim_time=False, pose_topic=True, discovery_wait=5.0) as s,
        driver([topic]),
        driver([topic]),
    ):
        s.node.trigger_configure()
        s.base.until(lambda: s.node.count_publishers(topic) == 3, "both drivers")
        assert s.node.trigger_activate() is not TransitionCallbackReturn.SUCCESS
        assert SHARED.format(topic) in s.node.failure


@pytest.mark.system
@pytest.mark.parametrize("topic", INPUTS)
def test_node_brakes_for_the_third_message_of_a_twin(topic):
    with stack(drive=True, pose_topic=True) as s:
        commands = s.base.run(40)
        with twin_of(KINDS[topic], topic) as twin:
            s.base.until(lambda: twin.get_subscription_count() == 1, "the node's subscription")
            # A publisher without messages does not count.
            s.base.run(20)
            assert not s.loop.stop_reason
            for _ in range(3):
                twin.publish(message_of(topic, time_message(s.base.now)))
                s.base.run(1)
            s.base.run(1)
            assert s.loop.stop_reason == SHARED.format(topic)
            braking = s.base.run(60)
            assert not braking[-1].any() and commands[-1, 0] > 0.1
        s.base.until(lambda: not s.loop.stop_reason, "the end of the reason")
        s.base.run(2)
        assert s.trigger("resume").success
        assert s.base.run(40)[-1, 0] > 0.1


@pytest.mark.system
def test_publisher_of_commands_under_the_name_of_the_node_is_reported():
    objection = "/diffdrive_mpc also publishes on /cmd_vel"
    with stack(drive=True, exclusive_cmd_vel=True) as s:
        s.base.run(20)
        with twin_of(TwistStamped, "cmd_vel", "diffdrive_mpc"):
            s.base.until(lambda: s.loop.stop_reason.startswith(objection), "the objection")
            assert not s.base.run(60)[-1].any()
