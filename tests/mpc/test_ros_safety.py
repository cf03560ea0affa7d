"""What may go wrong while the node drives, each over DDS: it stops, says why, and its command keeps to the limits."""

import math

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_parts import CONFIG, DT, stack

from diffdrive_mpc.mpc.ros.control_loop import LoopState
from diffdrive_mpc.mpc.solver.backend import Solved
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.step_result import Mode

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
