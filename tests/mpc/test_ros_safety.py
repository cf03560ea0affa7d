"""The node stops where it should: silent inputs, holds, limits of speed."""

import math
from functools import reduce

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Quaternion
from lifecycle_msgs.msg import Transition
from rclpy.parameter import Parameter
from ros_parts import CONFIG, DT, stack
from std_srvs.srv import SetBool

from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.step_result import Mode

LIMITS = CONFIG.limits
WITHIN_SLEW = np.array([LIMITS.v_slew, LIMITS.omega_slew]) * DT + 1e-9
# Braking from full speed takes no longer, and never more than this many ticks.
BRAKING = math.ceil(max(LIMITS.v / LIMITS.v_slew, LIMITS.omega / LIMITS.omega_slew) / DT) + 1


def assert_smooth(commands):
    """Check that commands are finite, within limits, and within slew from tick to tick."""
    assert np.isfinite(commands).all()
    assert (np.abs(commands) <= [LIMITS.v + 1e-9, LIMITS.omega + 1e-9]).all()
    assert (np.abs(np.diff(commands, axis=0)) <= WITHIN_SLEW).all()


def ticks(seconds):
    return math.ceil(seconds / DT)


def lost(odometry):
    return None


def altered(place, value):
    """Return a function that sets one entry of odometry, given by its dotted name."""

    def tamper(odometry):
        *parents, name = place.split(".")
        setattr(reduce(getattr, parents, odometry), name, value)
        return odometry

    return tamper


@pytest.mark.parametrize(
    ("tamper", "reason"),
    [
        (lost, "odometry is 0.2"),
        (altered("pose.pose.position.x", math.nan), "its pose is not finite"),
        (altered("twist.twist.linear.x", math.inf), "its twist is not finite"),
        (altered("header.frame_id", "map"), "its frame_id is 'map', expected 'odom'"),
        (altered("child_frame_id", "laser"), "its child_frame_id is 'laser', expected 'base_link'"),
        (altered("pose.pose.orientation", Quaternion(w=0.0)), "no unit quaternion"),
        (altered("header.stamp.sec", 0), "s before the last"),
        (altered("header.stamp.sec", 1000), "s in the future: are the clocks in step?"),
    ],
)
def test_robot_brakes_without_good_odometry_and_then_resumes(tamper, reason):
    with stack(drive=True) as s:
        good = s.base.run(30)
        assert s.loop.last.mode == Mode.TRACKING
        s.base.tamper = tamper
        late = s.base.run(int(0.2 / DT))
        assert s.loop.last.mode == Mode.TRACKING
        braking = s.base.run(2)
        assert s.loop.last.mode == Mode.BRAKING
        assert reason in s.loop.last.message
        # Less than failure.resume_within altogether.
        stopped = s.base.run(ticks(0.6))
        assert not stopped[-1].any()
        assert s.loop.last.mode == Mode.STOPPED
        s.base.tamper = lambda odometry: odometry
        again = s.base.run(40)
        assert s.loop.last.mode == Mode.TRACKING
        assert again[-1, 0] > 0.3
        assert_smooth(np.vstack([good, late, braking, stopped, again]))


@pytest.mark.parametrize("ahead", [1.0, 100.0, 1000.0])
def test_one_future_stamp_rejects_one_message_only(ahead):
    """One future stamp on each topic does not affect later messages."""
    with stack(drive=True, pose_topic=True) as s:
        s.base.run(30)
        topics = s.node._inbox.topics
        before = [topic.accepted for topic in topics]
        s.base.ahead = int(ahead * 1e9)
        s.base.run(1)
        s.base.ahead = 0
        commands = s.base.run(20)
        assert s.loop.last.mode == Mode.TRACKING
        assert [topic.accepted for topic in topics] == [count + 20 for count in before]
        assert all("s in the future" in topic.last_refusal for topic in topics)
        assert not any(topic.reason for topic in topics)
        assert commands[-1, 0] > 0.1


def test_robot_waits_for_start_if_resume_is_off():
    with stack({"failure.resume": False}, drive=True) as s:
        s.base.run(20)
        s.base.tamper = lost
        s.base.run(ticks(0.2) + BRAKING)
        s.base.tamper = lambda odometry: odometry
        assert not s.base.run(20).any()
        assert "stopped after a failure" in s.loop.last.message
        assert s.trigger("start").success
        assert s.base.run(20)[-1, 0] > 0.1


def test_exception_in_a_step_sends_zero_and_node_recovers(monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("a fault in the code")

    with stack(drive=True) as s:
        s.base.run(20)
        with monkeypatch.context() as patch:
            patch.setattr(s.node._controller, "step", broken)
            assert not s.base.run(5).any()
        assert s.loop.state is LoopState.FAULT
        assert "ZeroDivisionError: a fault in the code" in s.loop.last.message
        assert s.trigger("start").success
        assert s.base.run(20)[-1, 0] > 0.1


def test_blocked_robot_is_paused():
    with stack(drive=True, blocked_timeout=1.0) as s:
        before = s.base.run(20)
        s.base.held = True
        s.base.plant.reset(s.base.plant.true_pose)
        held = s.base.run(ticks(3.0))
        assert s.loop.state is LoopState.PAUSED
        assert "blocked for 1.0 s; clear the way and call start" in s.loop.last.message
        assert not held[-1].any()
        assert_smooth(np.vstack([before, held]))
        s.base.held = False
        assert s.trigger("start").success
        assert s.base.run(40)[-1, 0] > 0.3
        assert s.loop.last.mode == Mode.TRACKING
        assert s.loop.state is LoopState.DRIVING


def test_robot_stops_inside_its_fence_and_start_keeps_it_inside():
    fence = {
        "fence.enabled": True,
        "fence.length": 0.8,
        "fence.width": 0.8,
        "fence.margin": 0.1,
        "fence.frame": "poses",
    }
    with stack(drive=True, **fence) as s:
        braked = s.base.run(ticks(3.0))
        assert s.loop.last.mode == Mode.STOPPED
        assert "leaves the fence of 0.8 by 0.8 m; call start or reset" in s.loop.last.message
        assert_smooth(braked)
        assert np.abs(s.base.plant.true_pose[:2]).max() < 0.4
        assert s.trigger("start").success
        s.base.run(ticks(1.0))
        assert s.loop.last.mode == Mode.STOPPED
        assert np.abs(s.base.plant.true_pose[:2]).max() < 0.4


def test_paused_simulated_time_pauses_commands():
    with stack(drive=True) as s:
        before = s.base.run(30)
        count = len(s.base.commands)
        for _ in range(200):
            s.base.spin()
        assert len(s.base.commands) == count
        after = s.base.run(10)
        assert s.loop.last.mode == Mode.TRACKING
        assert_smooth(np.vstack([before, after]))


def test_backward_jump_of_simulated_time_stops_the_robot():
    with stack(drive=True) as s:
        s.base.run(60)
        s.base.tick = 0
        s.base.silent(BRAKING)
        assert s.base.commands[-1] == (0.0, 0.0)
        assert "time ran backwards" in s.loop.last.message
        assert s.trigger("reset").success
        s.base.silent(2)
        assert s.trigger("start").success
        s.base.run(10)
        assert s.loop.last.mode == Mode.TRACKING


@pytest.fixture
def limited(ros_types):
    """A robot that drives, and who limits it."""
    from nav2_msgs.msg import SpeedLimit

    with stack(drive=True) as s:
        publisher = s.publisher(SpeedLimit, "speed_limit", 10)

        def limit(value, *, percentage=False):
            publisher.publish(SpeedLimit(speed_limit=value, percentage=percentage))

        yield s, limit


def settle(s, wanted):
    s.base.until(lambda: s.node._controller.speed_limit == wanted, "the limit")
    return s.base.run(60)


def test_speed_limit_in_metres_and_percent_is_kept_until_cleared(limited):
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
    part = s.node.parts["speed_limit"]
    assert "speed limit refused" in part.fault
    limit(0.3)
    settle(s, 0.3)
    assert not part.fault


def test_percentage_limit_follows_its_base_and_outlasts_deactivation(limited):
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


HELD_BRAKING = np.array([LIMITS.v_braking, LIMITS.omega_braking]) * DT + 1e-9
SLEW = np.array([LIMITS.v_slew, LIMITS.omega_slew]) * DT + 1e-9
TO_REST = math.ceil(max(LIMITS.v / LIMITS.v_braking, LIMITS.omega / LIMITS.omega_braking) / DT) + 1


def hold(s, on):
    response = s.call(SetBool, "/diffdrive_mpc/hold", SetBool.Request(data=on))
    assert response.success
    return response.message


def tracking_distance(s):
    """Return the distance of the true pose from the path of the circle [m]."""
    x, y, _ = s.base.plant.true_pose
    return abs(math.hypot(x, y - 1.0) - 1.0)


def test_hold_brakes_within_limits_and_release_resumes_the_goal():
    with stack(drive=True) as s:
        before = s.base.run(60)
        assert hold(s, on=True) == "is held; brakes"
        braking = s.base.run(TO_REST)
        assert (np.abs(np.diff(np.vstack([before[-1:], braking]), axis=0)) <= HELD_BRAKING).all()
        # As hard as it may: the speed is gone as soon as its limit allows.
        needed = math.ceil(before[-1, 0] / (LIMITS.v_braking * DT) - 1e-9)
        assert not braking[needed:].any()
        assert s.loop.last.mode == Mode.STOPPED
        assert s.loop.state is LoopState.DRIVING
        begun = s.loop.begun
        assert not s.base.run(100).any()
        assert hold(s, on=True) == "is held already"
        assert hold(s, on=False) == "let go; drives on"
        again = s.base.run(100)
        assert (np.abs(np.diff(np.vstack([np.zeros((1, 2)), again]), axis=0)) <= SLEW).all()
        assert s.loop.begun is begun
        assert s.loop.last.mode == Mode.TRACKING
        assert again[-1, 0] > 0.3
        assert tracking_distance(s) < 0.02
        assert hold(s, on=False) == "was not held"


def test_held_robot_accepts_services_without_moving():
    with stack() as s:
        assert hold(s, on=True) == "is held"
        response = s.trigger("start")
        assert response.success
        assert response.message.endswith("once it is let go (hold)")
        assert not s.base.run(20).any()
        assert s.loop.state is LoopState.DRIVING
        assert "held; call hold with false" in s.loop.last.message
        assert s.trigger("pause").success
        assert hold(s, on=False).startswith("let go; stands; call start to drive")
        assert not s.base.run(20).any()
        hold(s, on=True)
        assert "once it is let go" in s.trigger("start").message
        assert not s.base.run(20).any()
        assert s.trigger("reset").success
        assert s.loop.held
        assert not s.base.run(2).any()
        assert s.trigger("start").success
        assert not s.base.run(5).any()
        hold(s, on=False)
        assert s.base.run(20)[-1, 0] > 0.1


@pytest.mark.parametrize("while_active", [True, False])
def test_hold_outlasts_deactivation_and_cleanup(while_active):
    with stack(drive_on_activate=True, autostart=while_active) as s:
        if while_active:
            s.base.run(20)
        assert hold(s, on=True) == ("is held; brakes" if while_active else "is held once it is active")
        if while_active:
            for number in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
                assert s.change(number)
        for number in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert s.change(number)
        s.base.until(s.has_received_inputs, "sensors")
        assert not s.base.run(20).any()
        assert hold(s, on=False) == "let go; drives on"
        assert s.base.run(20)[-1, 0] > 0.1


def test_hold_is_no_failure_and_appears_in_diagnostics():
    with stack({"failure.resume": False}, drive=True, diagnostics_rate=20.0) as s:
        heard = s.listen(DiagnosticArray, "/diagnostics")
        s.base.run(20)
        hold(s, on=True)
        s.base.run(TO_REST)
        s.base.until(lambda: heard and "STOPPED: held" in heard[-1].status[0].message, "diagnostics")
        status = heard[-1].status[0]
        assert status.level == DiagnosticStatus.WARN
        assert {item.key: item.value for item in status.values}["held"] == "yes"
        hold(s, on=False)
        assert s.base.run(20)[-1, 0] > 0.1
