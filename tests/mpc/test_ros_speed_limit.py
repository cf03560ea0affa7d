"""Nav2's speed_limit over DDS, by its generated type."""

import math

import numpy as np
import pytest
from rclpy.parameter import Parameter
from ros_parts import CONFIG, DT, stack


@pytest.fixture
def limited(ros_types):
    """A robot that drives, and who limits it."""
    from nav2_msgs.msg import SpeedLimit

    with stack(drive=True) as s:
        publisher = s.base.node.create_publisher(SpeedLimit, "speed_limit", 10)
        s.base.until(lambda: publisher.get_subscription_count() == 1, "the node's subscription")

        def limit(value, *, percentage=False):
            publisher.publish(SpeedLimit(speed_limit=value, percentage=percentage))

        yield s, limit


def settle(s, wanted):
    s.base.until(lambda: s.node._controller.speed_limit == wanted, "the limit")
    return s.base.run(60)


def test_in_metres_and_percent_and_off_again(limited):
    s, limit = limited
    assert s.base.run(60)[-1, 0] > 0.4
    limit(0.2)
    assert abs(settle(s, 0.2)[-20:, 0]).max() <= 0.2 + 1e-9
    limit(10.0, percentage=True)
    wanted = 0.1 * CONFIG.limits.v
    assert abs(settle(s, pytest.approx(wanted))[-20:, 0]).max() <= wanted + 1e-9
    limit(0.0)
    assert settle(s, None)[-1, 0] > 0.4


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.2])
def test_what_is_no_limit_is_refused_and_the_last_stays(limited, value, capfd):
    s, limit = limited
    limit(0.2)
    settle(s, 0.2)
    limit(value)
    s.base.until(lambda: "speed limit refused, the last one stays" in capfd.readouterr().err, "the refusal")
    assert s.node._controller.speed_limit == 0.2


def test_a_percentage_follows_the_limit_that_it_is_of_and_outlasts_deactivation(limited):
    s, limit = limited
    s.base.run(20)
    limit(20.0, percentage=True)
    settle(s, pytest.approx(0.2 * CONFIG.limits.v))
    s.node.set_parameters([Parameter("limits.v", value=1.0)])
    assert s.node._controller.speed_limit == pytest.approx(0.2)
    assert np.abs(s.base.run(round(1.0 / DT))[-10:, 0]).max() <= 0.2 + 1e-9
    s.node.trigger_deactivate()
    s.node.trigger_activate()
    assert s.node._controller.speed_limit == pytest.approx(0.2)
