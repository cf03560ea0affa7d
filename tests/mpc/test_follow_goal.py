"""Goals of follow_path without ROS: missing responses of the side process, and goals that are replaced or cancelled."""

from types import SimpleNamespace

import numpy as np
import pytest

from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.ros import follow_goal
from diffdrive_mpc.mpc.ros.control_loop import LoopState, LoopTick
from diffdrive_mpc.mpc.ros.follow_goal import Code, FollowGoal, Following, GoalOutcome, path_limits, plan_for_robot
from diffdrive_mpc.mpc.ros.settings import NodeSettings

X = np.linspace(0.0, 1.0, 21)
STRAIGHT = np.column_stack([X, 0 * X, 0 * X])
CONFIG, SETTINGS = load_config("ssm"), NodeSettings()


def resting_loop():
    """Return a stub of the control loop of a robot at rest that records its calls."""
    loop = SimpleNamespace(inbox=SimpleNamespace(now=0.0), state=LoopState.IDLE, drive=None, held=False, blocked=False)
    loop.wait_reason, loop.calls, loop.drive_fault = "", [], str
    loop.pose_and_twist = lambda: (np.zeros(3), (0.0, 0.0))
    for name in ("follow", "brake", "release"):
        setattr(loop, name, lambda *_, name=name: loop.calls.append(name))
    return loop


class SideProcess:
    """Stub of the side process that stores requests until the test responds."""

    def __init__(self):
        self.requests = []

    def __call__(self, arguments, done, failed):
        self.requests.append((arguments, done, failed))

    def respond(self):
        arguments, done, failed = self.requests.pop(0)
        try:
            done(plan_for_robot(*arguments))
        except ValueError as error:
            failed(str(error))


@pytest.fixture
def parts():
    loop, side = resting_loop(), SideProcess()
    following = Following(loop, SETTINGS, lambda: CONFIG, lambda: np.eye(2), side, lambda poses, frame, stamp: poses)
    return loop, side, following


def followed_goal(following, side):
    """Return a goal that the loop follows."""
    following.receive(goal := FollowGoal(STRAIGHT, "odom"))
    side.respond()
    return goal


def idle_tick():
    return LoopTick(np.zeros(2), LoopState.IDLE, "")


def test_goal_waits_for_its_path_and_then_for_the_loop(parts):
    loop, side, following = parts
    goal = FollowGoal(STRAIGHT, "odom")
    following.receive(goal)
    following.update(idle_tick())
    assert loop.calls == [] and goal.end is None
    side.respond()
    assert loop.calls == ["follow"] and goal.path.length == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("robot", "poses"),
    [
        ((1.0, 0.0, 0.0), STRAIGHT),
        ((1.03, 0.01, 0.0), STRAIGHT),
        ((1.0, 0.0, 0.0), STRAIGHT[-1:].repeat(2, axis=0)),
        # A planner's line from the robot that is too short for a turn.
        ((1.0, 0.01, 0.0), np.array([[1.0, 0.01, 0.0], [1.0, 0.0, 0.0]])),
    ],
)
def test_goal_at_the_position_of_the_robot_succeeds(parts, robot, poses):
    loop, side, following = parts
    loop.pose_and_twist = lambda: (np.array(robot), (0.0, 0.0))
    following.receive(goal := FollowGoal(poses, "odom"))
    side.respond()
    assert (goal.end.outcome, goal.end.code) == (GoalOutcome.SUCCEEDED, Code.NONE)
    assert loop.calls == []


@pytest.mark.parametrize("state", [((1.0, 0.0, 0.0), (0.1, 0.0)), ((1.2, 0.0, 0.0), (0.0, 0.0)), None])
def test_empty_path_is_rejected_if_the_robot_moves_or_is_not_at_the_goal(parts, state):
    loop, side, following = parts
    old = followed_goal(following, side)
    loop.pose_and_twist = lambda: (np.array([1.0, 0.0, 0.0]), (0.0, 0.0) if state is None else state[1])
    following.receive(goal := FollowGoal(STRAIGHT, "odom"))
    loop.pose_and_twist = lambda: state and (np.array(state[0]), state[1])
    side.respond()
    code = Code.TF_ERROR if state is None else Code.INVALID_PATH
    assert (goal.end.outcome, goal.end.code) == (GoalOutcome.ABORTED, code)
    # The drive of the replaced goal ends as well.
    following.update(idle_tick())
    assert loop.calls == ["follow", "brake", "release"] and old.end.outcome is GoalOutcome.ABORTED


def test_newer_goal_aborts_a_goal_that_has_not_started(parts):
    loop, side, following = parts
    first, second = FollowGoal(STRAIGHT, "odom"), FollowGoal(STRAIGHT, "odom")
    following.receive(first)
    following.receive(second)
    assert (first.end.outcome, first.end.code) == (GoalOutcome.ABORTED, Code.NONE)
    # The path of the first goal arrives after the second goal.
    side.respond()
    assert loop.calls == []
    side.respond()
    assert loop.calls == ["follow"] and second.end is None


def test_cancellation_before_the_start_ends_the_drive_of_the_replaced_goal(parts):
    loop, side, following = parts
    old = followed_goal(following, side)
    following.receive(newer := FollowGoal(STRAIGHT, "odom"))
    newer.cancelled = True
    following.update(idle_tick())
    assert newer.end.outcome is GoalOutcome.CANCELED
    assert loop.calls == ["follow", "brake", "release"]
    assert (old.end.outcome, old.end.message) == (GoalOutcome.ABORTED, "a newer goal was cancelled")
    side.respond()
    assert loop.calls == ["follow", "brake", "release"]


def test_goal_whose_path_never_arrives_times_out(parts, monkeypatch):
    _, side, following = parts
    goal = FollowGoal(STRAIGHT, "odom")
    following.receive(goal)
    goal.received_at -= follow_goal._MAX_PLANNING_TIME + 1.0
    following.update(idle_tick())
    assert goal.end.code is Code.CONTROLLER_TIMED_OUT
    following.receive(second := FollowGoal(STRAIGHT, "odom"))
    side.requests[-1][2]("its conversion takes longer than 10 s")
    assert second.end.code is Code.CONTROLLER_TIMED_OUT


def test_fault_of_the_loop_ends_the_goal(parts):
    _, side, following = parts
    goal = followed_goal(following, side)
    following.update(LoopTick(np.zeros(2), LoopState.FAULT, "ValueError: nothing"))
    assert (goal.end.code, goal.end.message) == (Code.UNKNOWN, "ValueError: nothing")


def test_goal_without_pose_ends_after_the_follow_patience(parts):
    loop, side, following = parts
    goal = followed_goal(following, side)
    loop.inbox.now = 0.9 * SETTINGS.follow_patience
    following.update(idle_tick())
    assert goal.end is None
    loop.inbox.now = 1.1 * SETTINGS.follow_patience
    following.update(idle_tick())
    assert (goal.end.code, goal.end.message) == (Code.TF_ERROR, "no pose arrives")


def test_path_limits_stay_below_the_limits_of_the_robot():
    gain = np.diag([0.5, 2.0])
    bounds = path_limits(CONFIG, gain, SETTINGS)
    assert bounds.v == pytest.approx(SETTINGS.follow_speed_share * 0.5 * CONFIG.limits.v)
    assert bounds.omega == pytest.approx(SETTINGS.follow_speed_share * CONFIG.limits.omega)
    assert bounds.v_acceleration < CONFIG.limits.v_slew and bounds.omega_acceleration < CONFIG.limits.omega_slew


def test_robot_waits_for_a_silent_client_continues_and_finally_aborts(parts, monkeypatch):
    loop, side, following = parts
    goal = followed_goal(following, side)
    start = goal.alive_at
    driving_tick = LoopTick(np.array([0.6, 0.0]), LoopState.DRIVING, "")
    distance = 0.0
    for count in range(200):
        goal.missed_checks = count
        monkeypatch.setattr(follow_goal.time, "monotonic", lambda now=start + count * CONFIG.sample_time: now)
        following.update(driving_tick)
        if loop.wait_reason:
            break
        distance += 0.6 * CONFIG.sample_time
    braking = 0.6**2 / (2.0 * CONFIG.limits.v_braking)
    assert SETTINGS.follow_blind_distance - 0.35 < distance + braking < SETTINGS.follow_blind_distance - 0.1
    following.update(idle_tick())
    assert "does not acknowledge" in loop.wait_reason and goal.ending is None
    goal.missed_checks, goal.alive_at = 0, goal.alive_at + 2.0
    following.update(idle_tick())
    assert loop.wait_reason == ""
    goal.missed_checks = 3
    monkeypatch.setattr(follow_goal.time, "monotonic", lambda: goal.alive_at + 5.1)
    following.update(idle_tick())
    assert goal.end.outcome is GoalOutcome.ABORTED and "its client has ended" in goal.end.message


def test_speed_of_a_path_is_limited_so_that_the_blind_distance_suffices():
    limited, unlimited = (
        path_limits(CONFIG, np.eye(2), NodeSettings(follow_speed_share=1.0, follow_blind_distance=distance)).v
        for distance in (0.2, 0.0)
    )
    delay = follow_goal._SILENCE + follow_goal._REACTION_TIME
    assert limited * delay + limited**2 / (2.0 * CONFIG.limits.v_braking) == pytest.approx(0.2)
    assert unlimited == min(CONFIG.limits.v, CONFIG.limits.wheel_speed) > limited
