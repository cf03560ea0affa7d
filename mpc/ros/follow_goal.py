"""Life cycle of a `follow_path` goal (plan, drive, monitor, finish), independent of ROS.

All methods run in the thread of the control loop. The thread of the action server writes the attributes of `FollowGoal`
that describe the client.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, LoopState, LoopTick
from diffdrive_mpc.mpc.ros.reference_input import tracking_error
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.planned.planned_path import PlannedPath, remaining_poses, time_poses

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.ros.node_part import PathCheck

_STANDSTILL_SPEED = 0.02
"""Speed below which the robot counts as at rest [m/s]."""
_MAX_POSE_AGE = 0.3
"""Maximum age of the pose from which a path for a moving robot was planned [s]."""
_MAX_OUTDATED_PATHS = 3
"""Number of paths from outdated poses after which the robot stops before the path is planned again."""
_MAX_PLANNING_TIME = 15.0
"""Time limit for planning a path [s, computer's clock]."""
_SILENT_MESSAGE = "the client of the goal does not acknowledge feedback"
_ABANDONED_MESSAGE = "its client has ended"
_MIN_MISSED_CHECKS, _SILENCE = 3, 0.3
"""Number of failed checks, and time [s], after which a client counts as silent.

Clients acknowledge within 0.1 s even on a loaded machine.
"""
_MAX_SILENCE = 5.0
"""Time without acknowledgement after which a goal is aborted [s].

The identification of a dead client among several clients takes up to 3 s.
"""
_REACTION_TIME = 0.4
"""Maximum time between two checks of a client, plus time from the decision to the first braking command [s]."""
_REST_TIME = 1.0
"""Duration of zero commands after which the robot counts as at rest, whatever its measured speed [s]."""


class Code(IntEnum):
    """Error codes of the result; the values are those of Nav2 for ROS 2 Jazzy."""

    NONE = 0
    UNKNOWN = 100
    INVALID_CONTROLLER = 101
    TF_ERROR = 102
    INVALID_PATH = 103
    PATIENCE_EXCEEDED = 104
    FAILED_TO_MAKE_PROGRESS = 105
    NO_VALID_CONTROL = 106
    CONTROLLER_TIMED_OUT = 107


class GoalOutcome(StrEnum):
    """Outcome of a goal."""

    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


@dataclass(frozen=True)
class End:
    """Outcome of a goal with its error code and a description."""

    outcome: GoalOutcome
    code: Code
    message: str


@dataclass(eq=False)
class FollowGoal:
    """Goal of `follow_path`.

    The thread of the loop writes `progress` and `end`; the thread of the action server writes `cancelled`, `alive_at`
    and `missed_checks`.

    Attributes
    ----------
    poses
        (n, 3) poses of the path in `frame`; `Following.receive` transforms them to the control frame.
    frame
        Frame of the path.
    stamp
        Time of the path [ns]; 0 if unknown.
    fault
        Code and reason of an error that was detected before the goal reached the loop; None if there was no error.
    cancelled
        True if cancellation was requested.
    clients
        GIDs of the clients that may have sent the goal.
    alive_at
        Time of the last successful check of the client [s, `time.monotonic`].
    missed_checks
        Number of failed checks since `alive_at`.
    progress
        Distance to the goal along the path [m] and speed [m/s]; None before the drive.
    end
        Result of the goal; None while it is active.
    path
        Reference along the path; None before the drive.
    requested_at
        Time at which the path was requested from the side process, on the controller's clock [s].
    received_at
        Time at which the goal was received [s, `time.monotonic`].
    outdated_paths
        Number of paths that were planned from an outdated pose.
    has_started
        True if the loop has started the drive of this goal.
    valid_since
        Time of the last progress or requested stop, on the controller's clock [s].
    blind_since, blind_distance
        Value of `alive_at` from which `blind_distance`, the distance driven without the client [m], is counted.
    is_waiting
        True while the robot stops for a client that does not acknowledge feedback.
    ending
        Result of the goal, which becomes `end` when the robot is at rest; None while the goal continues.
    """

    poses: FloatArray
    frame: str
    stamp: int = 0
    fault: tuple[Code, str] | None = None
    cancelled: bool = False
    clients: frozenset[bytes] = frozenset()
    alive_at: float = field(default_factory=time.monotonic)
    missed_checks: int = 0
    progress: tuple[float, float] | None = None
    end: End | None = None
    path: PlannedPath | None = field(default=None, repr=False)
    requested_at: float = 0.0
    received_at: float = 0.0
    outdated_paths: int = 0
    has_started: bool = False
    valid_since: float = math.nan
    blind_since: float = math.nan
    blind_distance: float = 0.0
    is_waiting: bool = False
    ending: End | None = None


class FrameError(DiffdriveMpcError, ValueError):
    """Error for a path that cannot be transformed to the control frame; the message is the reason."""


PlanFunction = Callable[[tuple[object, ...], Callable[[PlannedPath | None], None], Callable[[str], None]], None]
"""Function that calls `plan_for_robot` with the arguments in the first parameter.

The second parameter is a callback for the result, the third a callback for the reason of a failure.
"""


def plan_for_robot(
    poses: FloatArray,
    robot: FloatArray,
    twist: tuple[float, float],
    limits: TrajectoryLimits,
    settings: NodeSettings,
    config: ControllerConfig,
    checks: Sequence[PathCheck] = (),
) -> PlannedPath | None:
    """Plan a path that satisfies the conditions in `checks`, see `time_poses`; the side process calls this function.

    Returns None if the robot is at the goal and the remaining path is too short. Raises ConfigError for any other path
    that cannot be planned.
    """

    def plan_unchecked(limits: TrajectoryLimits) -> PlannedPath:
        return time_poses(
            poses,
            limits,
            robot=robot,
            twist=twist,
            deviation=settings.follow_deviation,
            max_offset=config.reentry.band,
            backwards=settings.follow_backwards,
        )

    plan: Callable[[TrajectoryLimits], PlannedPath] = plan_unchecked
    # Each check plans with the function of the previous check, so the path satisfies all conditions.
    for check in checks:
        plan = partial(check.plan, plan, config, abs(twist[0]))
    try:
        return plan(limits)
    except ConfigError:
        # A remaining path that is too short to be planned is not an error if the robot has arrived.
        remaining = remaining_poses(poses, robot)
        length = float(np.hypot(*np.diff(remaining[:, :2], axis=0).T).sum())
        if length > settings.follow_goal_position or not _has_arrived(_distance_and_angle(robot, poses[-1]), settings):
            raise
        return None


def _distance_and_angle(pose: FloatArray, goal: FloatArray) -> tuple[float, float]:
    """Compute distance [m] and angle [rad] between two poses (3,)."""
    gap = pose - goal
    return float(np.hypot(gap[0], gap[1])), abs(math.remainder(float(gap[2]), math.tau))


def _has_arrived(gap: tuple[float, float], settings: NodeSettings) -> bool:
    """Return True if `gap`, distance [m] and angle [rad] from the goal, is within the tolerances of `settings`."""
    return gap[0] <= settings.follow_goal_position and gap[1] <= settings.follow_goal_heading


def path_limits(config: ControllerConfig, gain: FloatArray, settings: NodeSettings) -> TrajectoryLimits:
    """Compute the speed and acceleration limits of a path: shares of the command limits times the DC `gain` (2, 2)."""
    limits, (v, omega) = config.limits, np.minimum(1.0, np.abs(np.diag(gain))).tolist()
    share, slew = settings.follow_speed_share, settings.follow_acceleration_share
    blind = _blind_speed(config, settings.follow_blind_distance)
    return TrajectoryLimits(
        v=limits.v.map(lambda side: min(share * min(v * side, limits.wheel_speed), blind)),
        omega=limits.omega.map(lambda side: share * omega * side),
        v_acceleration=limits.v_slew.map(lambda rate: slew * v * rate),
        omega_acceleration=limits.omega_slew.map(lambda rate: slew * omega * rate),
        min_turn_radius=limits.min_path_radius,
    )


def _blind_speed(config: ControllerConfig, distance: float) -> float:
    """Compute the maximum speed [m/s] from which the robot stops within `distance` [m] after the end of its client.

    The speed is infinite if `distance` is 0.
    """
    if not distance:
        return math.inf
    # Solution of distance = v delay + v^2 / (2 braking) for v.
    braking, delay = config.limits.v_braking, _SILENCE + _REACTION_TIME
    return braking * (math.sqrt(delay**2 + 2.0 * distance / braking) - delay)


def _speed(tick: LoopTick) -> float:
    """Return the estimated speed [m/s], or the commanded speed if there is no estimate."""
    estimate = None if tick.result is None else tick.result.estimate
    return abs(float(tick.command[0] if estimate is None else estimate.twist[0]))


def _planning_code(reason: str) -> Code:
    """Return the error code for a path that the side process rejected with the reason `reason`."""
    is_invalid = reason.startswith(("path:", "trajectory limit"))
    return Code.INVALID_PATH if is_invalid else Code.CONTROLLER_TIMED_OUT if "takes longer" in reason else Code.UNKNOWN


class Following:
    """Execution of goals by the control loop, one at a time; a new goal replaces the current goal.

    Parameters
    ----------
    loop
        Control loop of this activation.
    settings
        Settings of the node.
    config
        Function that returns the current configuration of the controller.
    gain
        Function that returns the steady-state gain (2, 2) of the controller's model.
    plan_function
        Function that plans a path in the side process.
    transform
        Function that transforms poses (n, 3) from a frame, at a time [ns], to the control frame; raises FrameError.
    """

    def __init__(
        self,
        loop: ControlLoop,
        settings: NodeSettings,
        config: Callable[[], ControllerConfig],
        gain: Callable[[], FloatArray],
        plan_function: PlanFunction,
        transform: Callable[[FloatArray, str, int], FloatArray],
    ) -> None:
        self._loop, self._settings, self._config, self._gain = loop, settings, config, gain
        self._plan_function, self._transform = plan_function, transform
        self._pending: FollowGoal | None = None
        self._current: FollowGoal | None = None

    def receive(self, goal: FollowGoal) -> None:
        """Plan the path of a goal, then drive along it; an invalid goal also ends the current drive."""
        if self._pending is not None:
            self._close(self._pending, GoalOutcome.ABORTED, Code.NONE, "a newer goal replaced it before its start")
        self._pending, goal.received_at = goal, time.monotonic()
        if goal.fault is not None:
            self._refuse(goal, *goal.fault)
            return
        if len(goal.poses) < 2:
            self._refuse(goal, Code.INVALID_PATH, f"the path has {len(goal.poses)} poses; give at least two")
            return
        try:
            goal.poses = self._transform(goal.poses, goal.frame, goal.stamp)
        except FrameError as error:
            self._refuse(goal, Code.TF_ERROR, str(error))
            return
        self._plan(goal)

    def update(self, tick: LoopTick) -> None:
        """Update the goals after a tick."""
        pending, goal = self._pending, self._current
        if pending is not None and pending.cancelled:
            self._pending = None
            self._close(pending, GoalOutcome.CANCELED, Code.NONE, "cancelled before its start")
            # The cancelled goal has already replaced the current goal, which must not continue.
            self._abort_current("a newer goal was cancelled")
        elif pending is not None and self._is_abandoned(pending):
            self._refuse(pending, Code.UNKNOWN, _ABANDONED_MESSAGE)
        elif pending is not None and time.monotonic() - pending.received_at > _MAX_PLANNING_TIME:
            self._refuse(pending, Code.CONTROLLER_TIMED_OUT, f"planning takes longer than {_MAX_PLANNING_TIME:g} s")
        if goal is None:
            return
        if goal.ending is None:
            # A waiting robot continues only after a successful check, not as soon as it has slowed down.
            goal.is_waiting = goal.missed_checks > 0 and (goal.is_waiting or self._has_to_brake(goal, _speed(tick)))
            self._loop.wait_reason = _SILENT_MESSAGE if goal.is_waiting else ""
            goal.ending = self._find_end(goal, tick)
            if goal.ending is not None and goal.ending.outcome is not GoalOutcome.SUCCEEDED:
                self._loop.brake(goal.ending.message)
        if goal.ending is not None and self._is_at_rest(goal, tick):
            self._current = None
            goal.end = goal.ending
            self._loop.release()
        elif tick.result is not None and goal.path is not None:
            goal.progress = self._progress(goal, tick)

    def stop(self, reason: str) -> None:
        """Abort all goals at the end of the control loop."""
        for goal in (self._pending, self._current):
            if goal is not None:
                self._close(goal, GoalOutcome.ABORTED, Code.UNKNOWN, reason)
        self._pending = self._current = None

    def _plan(self, goal: FollowGoal) -> None:
        loop, config = self._loop, self._config()
        pose_and_twist = loop.pose_and_twist()
        if pose_and_twist is None:
            self._refuse(goal, Code.TF_ERROR, loop.drive_fault() or "the robot's pose is not known yet")
            return
        robot, twist = pose_and_twist
        goal.requested_at = loop.inbox.now
        limits = path_limits(config, self._gain(), self._settings)
        self._plan_function(
            (goal.poses, robot, twist, limits, self._settings, config),
            lambda path: self._drive(goal, path, twist[0]),
            lambda reason: self._refuse(goal, _planning_code(reason), reason),
        )

    def _drive(self, goal: FollowGoal, path: PlannedPath | None, speed: float) -> None:
        if goal is not self._pending:
            return
        loop, max_distance = self._loop, self._config().failure.max_position_error
        is_moving = abs(speed) > _STANDSTILL_SPEED
        if is_moving and loop.inbox.now - goal.requested_at > _MAX_POSE_AGE:
            goal.outdated_paths += 1
            if goal.outdated_paths == _MAX_OUTDATED_PATHS:
                self._abort_current("a newer goal's path takes too long to prepare for a robot that moves")
            self._plan(goal)
            return
        if path is None:
            self._finish_at_goal(goal, is_moving=is_moving)
            return
        if path.start_distance > max_distance:
            reason = f"the path starts {path.start_distance:.2f} m from the robot; the limit is {max_distance:g} m"
            self._refuse(goal, Code.INVALID_PATH, f"{reason} (failure.max_position_error)")
            return
        try:
            # The path starts at the pose of the request; a moving robot has left this pose during planning.
            loop.follow(path.reference, goal.requested_at if is_moving else None)
        except ValueError as error:
            code = Code.TF_ERROR if loop.drive_fault() else Code.INVALID_PATH
            self._refuse(goal, code, str(error))
            return
        if self._current is not None:
            self._current.end = self._current.ending or End(GoalOutcome.ABORTED, Code.NONE, "a newer goal took over")
        goal.path, goal.valid_since = path, loop.inbox.now
        self._current, self._pending = goal, None

    def _finish_at_goal(self, goal: FollowGoal, *, is_moving: bool) -> None:
        """End a goal without a remaining path; it succeeds if the robot is at rest at the goal."""
        pose_and_twist = self._loop.pose_and_twist()
        if pose_and_twist is None:
            self._refuse(goal, Code.TF_ERROR, self._loop.drive_fault() or "the robot's pose is not known")
            return
        gap = (math.inf, math.inf) if is_moving else _distance_and_angle(pose_and_twist[0], goal.poses[-1])
        if not _has_arrived(gap, self._settings):
            self._refuse(goal, Code.INVALID_PATH, "path: the robot is at the end of the path, but not at rest")
            return
        self._pending, self._loop.refusal = None, ""
        message = f"already at the goal, {gap[0]:.3f} m and {gap[1]:.3f} rad from the goal"
        self._close(goal, GoalOutcome.SUCCEEDED, Code.NONE, message)
        self._abort_current("a newer goal took over")

    def _refuse(self, goal: FollowGoal, code: Code, reason: str) -> None:
        if goal is not self._pending:
            return
        self._pending, self._loop.refusal = None, f"goal refused: {reason}"
        self._close(goal, GoalOutcome.ABORTED, code, reason)
        self._abort_current(f"a newer goal could not be driven: {reason}")

    def _abort_current(self, reason: str) -> None:
        """Abort the current goal and brake."""
        if self._current is not None and self._current.ending is None:
            self._current.ending = End(GoalOutcome.ABORTED, Code.NONE, reason)
            self._loop.brake(reason)

    def _close(self, goal: FollowGoal, outcome: GoalOutcome, code: Code, message: str) -> None:
        goal.end = End(outcome, code, message)

    def _find_end(self, goal: FollowGoal, tick: LoopTick) -> End | None:
        """Return the end of the goal after a tick, or None while the goal continues."""
        loop, settings, now = self._loop, self._settings, self._loop.inbox.now
        assert goal.path is not None
        is_current = loop.drive is not None and loop.drive.reference is goal.path.reference
        goal.has_started = goal.has_started or is_current
        if goal.cancelled:
            return End(GoalOutcome.CANCELED, Code.NONE, "cancelled")
        if self._is_abandoned(goal):
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, _ABANDONED_MESSAGE)
        if tick.state is LoopState.FAULT:
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, tick.message)
        if goal.has_started and (not is_current or tick.state is LoopState.IDLE):
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, "another reference was started, or the node was reset")
        if not goal.has_started:
            is_late = now - goal.valid_since > settings.follow_patience and not loop.held
            return End(GoalOutcome.ABORTED, Code.TF_ERROR, loop.drive_fault() or "no pose arrives") if is_late else None
        if loop.blocked:
            return End(GoalOutcome.ABORTED, Code.FAILED_TO_MAKE_PROGRESS, tick.message or "blocked")
        result = tick.result
        # Requested stops restart `follow_patience`.
        if result is None or tick.state is LoopState.PAUSED or loop.held or goal.is_waiting:
            goal.valid_since = now
            return None
        if result.mode is Mode.FINISHED:
            # The distance from the goal is evaluated at rest, after the command has ramped to zero.
            return None if tick.command.any() else self._arrival(goal, tick)
        if result.mode is Mode.TRACKING:
            goal.valid_since = now
        if now - goal.valid_since <= settings.follow_patience:
            return None
        return End(GoalOutcome.ABORTED, self._error_code(tick), tick.message or "no valid command was found")

    def _has_to_brake(self, goal: FollowGoal, speed: float) -> bool:
        """Return True if a robot at `speed` [m/s] must brake now to stop within `follow_blind_distance`."""
        # A successful check resets the distance that the robot has driven without its client.
        if goal.blind_since != goal.alive_at:
            goal.blind_since, goal.blind_distance = goal.alive_at, 0.0
        config = self._config()
        goal.blind_distance += speed * config.sample_time
        stop = speed * _REACTION_TIME + 0.5 * speed**2 / config.limits.v_braking
        return self._silence(goal) > _SILENCE and goal.blind_distance + stop > self._settings.follow_blind_distance

    def _is_abandoned(self, goal: FollowGoal) -> bool:
        return self._silence(goal) > _MAX_SILENCE

    def _silence(self, goal: FollowGoal) -> float:
        """Return the time since the last successful check of the client [s]; 0 until several checks have failed."""
        if goal.missed_checks < _MIN_MISSED_CHECKS or not self._settings.follow_blind_distance:
            return 0.0
        return time.monotonic() - goal.alive_at

    def _arrival(self, goal: FollowGoal, tick: LoopTick) -> End:
        assert tick.result is not None
        settings, estimate = self._settings, tick.result.estimate
        if estimate is None:
            return End(GoalOutcome.ABORTED, Code.TF_ERROR, "at the end of the path the robot's pose is not known")
        gap = _distance_and_angle(estimate.pose, goal.poses[-1])
        message = f"{gap[0]:.3f} m and {gap[1]:.3f} rad from the goal"
        if _has_arrived(gap, settings):
            assert goal.path is not None
            note = f"; {goal.path.note}" if goal.path.note else ""
            return End(GoalOutcome.SUCCEEDED, Code.NONE, f"arrived, {message}{note}")
        return End(GoalOutcome.ABORTED, Code.FAILED_TO_MAKE_PROGRESS, f"the path has ended {message}")

    def _error_code(self, tick: LoopTick) -> Code:
        """Return the error code for a robot that has not driven for `follow_patience`."""
        assert tick.result is not None
        inbox = self._loop.inbox
        if inbox.odometry.fault(inbox.now, self._settings.odom_timeout) or tick.result.estimate is None:
            return Code.TF_ERROR
        if "no pose was accepted" in tick.message:
            return Code.TF_ERROR
        if tick.result.mode is Mode.REUSED_PLAN or "no way" in tick.message or "from the reference" in tick.message:
            return Code.NO_VALID_CONTROL
        return Code.PATIENCE_EXCEEDED

    def _is_at_rest(self, goal: FollowGoal, tick: LoopTick) -> bool:
        """Return True if the robot is at rest, by its estimated twist or after `_REST_TIME`."""
        now = self._loop.inbox.now
        if tick.command.any():
            goal.valid_since = now
            return False
        estimate = None if tick.result is None else tick.result.estimate
        is_still = estimate is not None and float(np.abs(estimate.twist).max()) <= _STANDSTILL_SPEED
        return is_still or tick.state in (LoopState.FAULT, LoopState.IDLE) or now - goal.valid_since > _REST_TIME

    def _progress(self, goal: FollowGoal, tick: LoopTick) -> tuple[float, float] | None:
        result, drive = tick.result, self._loop.drive
        assert result is not None
        assert goal.path is not None
        reference = goal.path.reference
        if result.estimate is None or drive is None or drive.reference is not reference:
            return goal.progress
        # Time on the clock of the reference, which may wait for the robot.
        time = self._loop.inbox.now - drive.t0 - result.reference_delay
        position, length = reference.sample([time, reference.duration]).arc_length.tolist()
        error = tracking_error(result)
        ahead = error[0] if error is not None else 0.0
        return max(0.0, length - position - ahead), abs(float(result.estimate.twist[0]))
