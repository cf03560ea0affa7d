"""A hold from outside, over DDS: it brakes at the limits, keeps the goal, and outlasts all else that is asked."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from nav_msgs.msg import Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import String
from std_srvs.srv import SetBool

from diffdrive_mpc.mpc.monitor.judge import Judge
from diffdrive_mpc.mpc.monitor.ros.node import planar, seconds
from diffdrive_mpc.mpc.monitor.rules import load_rules
from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.step_result import Mode

LIMITS = CONFIG.limits
BRAKING = np.array([LIMITS.v_braking, LIMITS.omega_braking]) * DT + 1e-9
SLEW = np.array([LIMITS.v_slew, LIMITS.omega_slew]) * DT + 1e-9
TO_REST = math.ceil(max(LIMITS.v / LIMITS.v_braking, LIMITS.omega / LIMITS.omega_braking) / DT) + 1


def hold(s, on):
    answer = s.call(SetBool, "/diffdrive_mpc/hold", SetBool.Request(data=on))
    assert answer.success
    return answer.message


def tracking_distance(s):
    """From the true pose to the path of the circle [m]."""
    x, y, _ = s.base.plant.true_pose
    return abs(math.hypot(x, y - 1.0) - 1.0)


def test_it_brakes_at_the_limits_keeps_the_goal_and_drives_on():
    with stack(drive=True) as s:
        before = s.base.run(60)
        assert hold(s, on=True) == "is held; brakes"
        braking = s.base.run(TO_REST)
        assert (np.abs(np.diff(np.vstack([before[-1:], braking]), axis=0)) <= BRAKING).all()
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


class Watch:
    """The judge of the monitor, told of what the node says, as by the monitor's process."""

    def __init__(self, s):
        self.base, self.paths = s.base, []
        self.judge = Judge(load_rules().with_sensors(pose=False, gyro=False), self.now)
        s.base.tamper = self.take_odometry
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        s.base.node.create_subscription(Path, "/diffdrive_mpc/reference_path", self.take_path, latched)
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


@pytest.mark.parametrize(("stop", "told"), [("hold", True), ("pause", True), ("pause", False)])
def test_the_monitor_lets_it_drive_on_with_its_reference_moved_on(stop, told, monkeypatch):
    """By as long as it stood: the reference that the monitor knew went on meanwhile."""
    if not told:
        monkeypatch.setattr("diffdrive_mpc.mpc.ros.control_loop._TELL_DELAY", math.inf)
    with stack(drive=True) as s:
        watch = Watch(s)
        watch.run(100)
        assert len(watch.paths) == 1
        hold(s, on=True) if stop == "hold" else s.trigger("pause")
        watch.run(400)
        assert not watch.judge.verdict and len(watch.paths) == 1
        hold(s, on=False) if stop == "hold" else s.trigger("start")
        watch.run(150)
        assert bool(watch.judge.verdict) is not told
        if told:
            late = np.array(watch.paths[-1])[:, 0] - np.array(watch.paths[0])[:, 0]
            assert late == pytest.approx(s.node._controller.planned_delay, abs=0.25) and (late > 7.0).all()


def test_pushed_off_its_path_while_held_it_rejoins_it():
    with stack(drive=True) as s:
        s.base.run(60)
        hold(s, on=True)
        s.base.run(TO_REST + 5)
        s.base.plant._pose[1] += 0.25
        s.base.run(40)
        hold(s, on=False)
        s.base.run(5)
        assert "rejoining" in s.loop.last.message
        s.base.run(250)
        assert s.loop.last.mode == Mode.TRACKING
        assert tracking_distance(s) < 0.03


def test_start_pause_and_reset_are_taken_but_do_not_move_it():
    with stack() as s:
        assert hold(s, on=True) == "is held"
        answer = s.trigger("start")
        assert answer.success
        assert answer.message.endswith("once it is let go (hold)")
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
def test_it_outlasts_deactivation_and_cleanup(while_active):
    with stack(drive_on_activate=True, autostart=while_active) as s:
        if while_active:
            s.base.run(20)
        assert hold(s, on=True) == ("is held; brakes" if while_active else "is held once it is active")
        if while_active:
            for number in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
                assert s.change(number)
        for number in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            assert s.change(number)
        s.base.until(s.hears, "sensors")
        assert not s.base.run(20).any()
        assert hold(s, on=False) == "let go; drives on"
        assert s.base.run(20)[-1, 0] > 0.1


def test_a_hold_is_no_failure_and_diagnostics_tell_it():
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
