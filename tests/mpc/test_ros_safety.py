"""The node stops where it should: silent inputs, holds, limits of speed."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Path
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import String
from std_srvs.srv import SetBool

from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.solver.backend import Solved
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc_monitor.judge import Judge
from diffdrive_mpc_monitor.ros.node import planar, seconds
from diffdrive_mpc_monitor.rules import load_rules

LIMITS = CONFIG.limits
WITHIN_SLEW = np.array([LIMITS.v_slew, LIMITS.omega_slew]) * DT + 1e-9
# Braking from full speed takes no longer, and never more than this many ticks.
BRAKING = math.ceil(max(LIMITS.v / LIMITS.v_slew, LIMITS.omega / LIMITS.omega_slew) / DT) + 1


def assert_smooth(commands):
    """Finite, inside the limits, and no faster than the slew limits from tick to tick."""
    assert np.isfinite(commands).all()
    assert (np.abs(commands) <= [LIMITS.v + 1e-9, LIMITS.omega + 1e-9]).all()
    assert (np.abs(np.diff(commands, axis=0)) <= WITHIN_SLEW).all()


def ticks(seconds):
    return math.ceil(seconds / DT)


def lost(odometry):
    return None


def not_finite(odometry):
    odometry.pose.pose.position.x = math.nan
    return odometry


def twist_not_finite(odometry):
    odometry.twist.twist.linear.x = math.inf
    return odometry


def other_frame(odometry):
    odometry.header.frame_id = "map"
    return odometry


def other_child_frame(odometry):
    odometry.child_frame_id = "laser"
    return odometry


def no_orientation(odometry):
    odometry.pose.pose.orientation.w = odometry.pose.pose.orientation.z = 0.0
    return odometry


def an_hour_ago(odometry):
    odometry.header.stamp.sec -= 1
    return odometry


def far_ahead(odometry):
    odometry.header.stamp.sec += 1000
    return odometry


@pytest.mark.parametrize(
    ("tamper", "reason"),
    [
        (lost, "odometry is 0.2"),
        (not_finite, "its pose is not finite"),
        (twist_not_finite, "its twist is not finite"),
        (other_frame, "its frame_id is 'map', expected 'odom'"),
        (other_child_frame, "its child_frame_id is 'laser', expected 'base_link'"),
        (no_orientation, "no unit quaternion"),
        (an_hour_ago, "s before the last"),
        (far_ahead, "s in the future: are the clocks in step?"),
    ],
)
def test_without_good_odometry_it_brakes_stands_and_drives_on(tamper, reason):
    with stack(drive=True) as s:
        good = s.base.run(30)
        assert s.loop.last.mode == Mode.TRACKING
        s.base.tamper = tamper
        late = s.base.run(int(0.2 / DT))
        assert s.loop.last.mode == Mode.TRACKING
        braking = s.base.run(2)
        assert s.loop.last.mode == Mode.BRAKING
        assert reason in s.loop.last.message
        stopped = s.base.run(BRAKING)
        assert not stopped[-1].any()
        assert s.loop.last.mode == Mode.STOPPED
        s.base.tamper = lambda odometry: odometry
        again = s.base.run(40)
        assert s.loop.last.mode == Mode.TRACKING
        assert again[-1, 0] > 0.3
        assert_smooth(np.vstack([good, late, braking, stopped, again]))


@pytest.mark.parametrize("ahead", [1.0, 100.0, 1000.0])
def test_one_stamp_from_the_future_costs_one_message(ahead):
    """Of each topic, on the way: what comes after it is believed as before."""
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


def test_without_leave_to_resume_it_waits_for_start():
    with stack({"failure.resume": False}, drive=True) as s:
        s.base.run(20)
        s.base.tamper = lost
        s.base.run(ticks(0.2) + BRAKING)
        s.base.tamper = lambda odometry: odometry
        assert not s.base.run(20).any()
        assert "stopped after a failure" in s.loop.last.message
        assert s.trigger("start").success
        assert s.base.run(20)[-1, 0] > 0.1


def test_a_single_jump_is_ignored_and_a_lasting_one_stops_it_first():
    def elsewhere(odometry):
        odometry.pose.pose.position.y += 0.5
        return odometry

    with stack(drive=True) as s:
        before = s.base.run(30)
        s.base.tamper = elsewhere
        one = s.base.run(1)
        assert s.loop.last.mode == Mode.TRACKING
        assert "jumps by 0.50 m" in s.loop.last.message
        s.base.tamper = lambda odometry: odometry
        s.base.run(3)
        s.base.tamper = elsewhere
        carried = s.base.run(4)
        assert s.loop.last.mode == Mode.BRAKING
        standing = s.base.run(BRAKING + 20)
        assert not np.abs(standing).sum(axis=1).all()
        onward = s.base.run(10)
        assert s.loop.last.mode == Mode.TRACKING
        assert_smooth(np.vstack([before, one]))
        assert_smooth(np.vstack([carried, standing, onward]))


class FailingBackend:
    def solve(self, program, kinds, guess, multipliers, time_limit=None):
        return Solved(guess, 0 * multipliers, SolverStatus.MAX_ITERATIONS)


def test_solver_failures_end_in_braking(monkeypatch):
    with stack(drive=True) as s:
        before = s.base.run(30)
        controller = s.node._controller
        controller._tick._constants[0].forced = 1
        monkeypatch.setattr(controller, "_backend", FailingBackend())
        reused = s.base.run(CONFIG.failure.max_reused_ticks)
        assert s.loop.last.mode == Mode.REUSED_PLAN
        braking = s.base.run(BRAKING + 1)
        assert s.loop.last.mode == Mode.STOPPED
        assert "the iteration limit was reached" in s.loop.last.message
        assert s.loop.fallbacks >= CONFIG.failure.max_reused_ticks
        assert_smooth(np.vstack([before, reused, braking]))


def test_an_exception_ends_in_zero_and_the_node_lives_on(monkeypatch):
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


def test_a_blocked_robot_is_paused():
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


def test_pushed_beyond_the_limit_it_stops_and_says_so():
    with stack(drive=True) as s:
        s.base.run(30)
        pushed = CONFIG.failure.max_position_error + 0.5
        s.base.plant._pose[1] -= pushed
        s.base.run(BRAKING + ticks(0.5))
        assert s.loop.last.mode == Mode.STOPPED
        assert f"from the reference; the limit is {CONFIG.failure.max_position_error} m" in s.loop.last.message


def test_before_it_leaves_its_fence_it_stops_and_start_does_not_let_it_out():
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


def test_deactivated_while_driving_zero_is_the_last_command():
    with stack(drive=True) as s:
        assert s.base.run(20)[-1, 0] > 0.1
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        assert s.call(ChangeState, "/diffdrive_mpc/change_state", request).success
        assert s.base.commands[-1] == (0.0, 0.0)
        assert s.base.silent(10) == 0
        s.call(
            ChangeState,
            "/diffdrive_mpc/change_state",
            ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE)),
        )
        assert not s.base.run(5).any()
        assert s.trigger("start").success
        assert s.base.run(20)[-1, 0] > 0.1


def test_paused_simulated_time_pauses_the_commands():
    with stack(drive=True) as s:
        before = s.base.run(30)
        count = len(s.base.commands)
        for _ in range(200):
            s.base.spin()
        assert len(s.base.commands) == count
        after = s.base.run(10)
        assert s.loop.last.mode == Mode.TRACKING
        assert_smooth(np.vstack([before, after]))


def test_simulated_time_that_runs_backwards_stops_it():
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


def test_without_poses_on_their_topic_it_brakes():
    with stack(drive=True, pose_topic=True) as s:
        assert s.base.run(20)[-1, 0] > 0.1
        s.base.pose_topic = False
        s.base.run(ticks(CONFIG.failure.dead_reckoning) + 2)
        assert s.loop.last.mode in (Mode.BRAKING, Mode.STOPPED)
        s.base.run(BRAKING)
        assert s.loop.last.mode == Mode.STOPPED
        assert "no pose was accepted" in s.loop.last.message


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


HELD_BRAKING = np.array([LIMITS.v_braking, LIMITS.omega_braking]) * DT + 1e-9
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
