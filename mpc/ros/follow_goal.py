"""Life cycle of a `follow_path` goal: plan, drive, monitor, finish; independent of ROS.

Everything runs in the thread of the control loop, except for the parts marked in `Goal`.
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
from diffdrive_mpc.mpc.trajectories.planned.lay import Laid, lay_poses, poses_left

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.ros.node_part import PathCheck

_STANDING = 0.02
"""Speed below which the robot counts as standing [m/s]."""
_OUTDATED = 0.3
"""Age of the robot's pose above which a moving robot gets no new reference [s]."""
_MOST_OUTDATED = 3
"""Number of outdated results after which a path is planned for a standing robot."""
_LONGEST_LAYING = 15.0
"""Time limit for planning a path, in seconds of the computer's clock."""
_SILENT = "the client of the goal does not acknowledge feedback"
_ABANDONED = "nobody waits for it any more: its client has ended"
_SILENT_CHECKS, _SILENCE = 3, 0.3
"""Number of checks, and time [s], after which a client counts as silent; on a loaded machine it acknowledges within 0.1
s.
"""
_LONGEST_SILENCE = 5.0
"""Time without its client after which a goal is abandoned [s]; distinguishing a dead client from another takes up to 3
s.
"""
_REACTION = 0.4
"""Time from the death of a client to the first check, and from the verdict to the first braking command [s]."""
_SETTLES = 1.0
"""Duration of zero commands after which the robot counts as standing, whatever its wheels report [s]."""


class Code(IntEnum):
    """Error codes of the result, as in Nav2 for ROS 2 Jazzy."""

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
    """Outcome of a goal with its code and the reason in words."""

    outcome: GoalOutcome
    code: Code
    words: str


@dataclass(eq=False)
class FollowGoal:
    """One goal. The loop's thread writes `progress` and `end`, and that of the action server the client's state.

    Attributes
    ----------
    poses
        (n, 3) of the path, in its frame.
    frame
        Frame of the path.
    stamp
        Time of the path [ns]; 0: none.
    fault
        Why it cannot be driven, as was found before the loop saw it; None if nothing was.
    cancelled
        Whether the goal is to be cancelled.
    clients
        GIDs of the clients that may have sent it.
    heard_at
        Time of the last check at which its client was alive, by `time.monotonic` [s].
    unheard
        Number of checks since then.
    progress
        Distance to the goal along the path [m] and speed [m/s]; None until it is driven.
    end
        Result of the goal; None while it is active.
    """

    poses: FloatArray
    frame: str
    stamp: int = 0
    fault: tuple[Code, str] | None = None
    cancelled: bool = False
    clients: frozenset[bytes] = frozenset()
    heard_at: float = field(default_factory=time.monotonic)
    unheard: int = 0
    progress: tuple[float, float] | None = None
    end: End | None = None
    laid: Laid | None = field(default=None, repr=False)
    asked_at: float = 0.0
    handed_on: float = 0.0
    outdated: int = 0
    began: bool = False
    since: float = math.nan
    blind_since: float = math.nan
    blind_distance: float = 0.0
    waits: bool = False
    ending: End | None = None


class FrameError(DiffdriveMpcError, ValueError):
    """A path cannot be brought into the frame of control; contains the reason."""


Lay = Callable[[tuple[object, ...], Callable[[Laid | None], None], Callable[[str], None]], None]
"""Function that calls `lay_for_robot` with these arguments, and then one of the two callbacks with the result."""


def lay_for_robot(
    poses: FloatArray,
    robot: FloatArray,
    twist: tuple[float, float],
    limits: TrajectoryLimits,
    settings: NodeSettings,
    config: ControllerConfig,
    checks: Sequence[PathCheck] = (),
) -> Laid | None:
    """Lay a path in the side process, see `lay_poses`; None if the robot is at the goal and the rest is too short.

    The path satisfies the conditions in `checks`. Raises ConfigError for any other path that cannot be laid.
    """

    def laid(limits: TrajectoryLimits) -> Laid:
        return lay_poses(
            poses,
            limits,
            robot=robot,
            twist=twist,
            deviation=settings.follow_deviation,
            beside=config.reentry.band,
            backwards=settings.follow_backwards,
        )

    lay: Callable[[TrajectoryLimits], Laid] = laid
    for check in checks:
        lay = partial(check.lay, lay, config, abs(twist[0]))
    try:
        return lay(limits)
    except ConfigError:
        left = poses_left(poses, robot)
        length = float(np.hypot(*np.diff(left[:, :2], axis=0).T).sum())
        if length > settings.follow_goal_position or not _within(_gap(robot, poses[-1]), settings):
            raise
        return None


def _gap(pose: FloatArray, goal: FloatArray) -> tuple[float, float]:
    """Compute distance [m] and angle [rad] between two poses (3,)."""
    gap = pose - goal
    return float(np.hypot(gap[0], gap[1])), abs(math.remainder(float(gap[2]), math.tau))


def _within(gap: tuple[float, float], settings: NodeSettings) -> bool:
    """Return True if a robot at this distance and angle from its goal has arrived."""
    return gap[0] <= settings.follow_goal_position and gap[1] <= settings.follow_goal_heading


def path_limits(config: ControllerConfig, gain: FloatArray, settings: NodeSettings) -> TrajectoryLimits:
    """Compute speeds and accelerations of a path: shares of those of the commands, times the steady-state `gain`."""
    limits, (v, omega) = config.limits, np.minimum(1.0, np.abs(np.diag(gain))).tolist()
    share, slew = settings.follow_speed_share, settings.follow_acceleration_share
    blind = _blind_speed(config, settings.follow_blind_distance)
    return TrajectoryLimits(
        v=limits.v.map(lambda side: min(share * min(v * side, limits.wheel_speed), blind)),
        omega=limits.omega.map(lambda side: share * omega * side),
        v_acceleration=limits.v_slew.map(lambda rate: slew * v * rate),
        omega_acceleration=limits.omega_slew.map(lambda rate: slew * omega * rate),
        min_turn_radius=limits.least_radius_of_ways,
    )


def _blind_speed(config: ControllerConfig, distance: float) -> float:
    """Return the highest speed [m/s] at which the robot stops within `distance` [m] of a death; 0 m: no limit."""
    if not distance:
        return math.inf
    braking, delay = config.limits.v_braking, _SILENCE + _REACTION
    return braking * (math.sqrt(delay**2 + 2.0 * distance / braking) - delay)


def _speed(tick: LoopTick) -> float:
    """Return the estimated speed [m/s], or the commanded one where there is no estimate."""
    estimate = None if tick.result is None else tick.result.estimate
    return abs(float(tick.command[0] if estimate is None else estimate.twist[0]))


def _not_laid(why: str) -> Code:
    """Return the code for a path that the side process rejected for the reason `why`."""
    ours = why.startswith(("path:", "trajectory limit"))
    return Code.INVALID_PATH if ours else Code.CONTROLLER_TIMED_OUT if "takes longer" in why else Code.UNKNOWN


class Following:
    """Takes goals to the control loop, one at a time; a newer one replaces the one that is driven.

    Parameters
    ----------
    loop
        Control loop of this activation.
    settings
        The node's.
    config
        The present configuration of the controller.
    gain
        (2, 2) steady-state gain of its model.
    lay
        Function that plans a path outside the loop.
    transform
        Brings poses (n, 3) from a frame, at a time [ns], into that of control; FrameError contains the reason if it
        cannot.
    """

    def __init__(
        self,
        loop: ControlLoop,
        settings: NodeSettings,
        config: Callable[[], ControllerConfig],
        gain: Callable[[], FloatArray],
        lay: Lay,
        transform: Callable[[FloatArray, str, int], FloatArray],
    ) -> None:
        self._loop, self._settings, self._config, self._gain = loop, settings, config, gain
        self._lay, self._transform = lay, transform
        self._coming: FollowGoal | None = None
        self._driven: FollowGoal | None = None

    def take(self, goal: FollowGoal) -> None:
        """Plan the path of a goal, then drive it. An unusable goal ends the current drive, too."""
        if self._coming is not None:
            self._close(self._coming, GoalOutcome.ABORTED, Code.NONE, "a newer goal took its place before it began")
        self._coming, goal.handed_on = goal, time.monotonic()
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
        self._ask(goal)

    def after(self, tick: LoopTick) -> None:
        """Judge the current goal by the last tick."""
        coming, goal = self._coming, self._driven
        if coming is not None and coming.cancelled:
            self._coming = None
            self._close(coming, GoalOutcome.CANCELED, Code.NONE, "cancelled before it began")
            # A client that sent it did not want the goal that it replaced either.
            self._give_up("a newer goal was cancelled")
        elif coming is not None and self._is_abandoned(coming):
            self._refuse(coming, Code.UNKNOWN, _ABANDONED)
        elif coming is not None and time.monotonic() - coming.handed_on > _LONGEST_LAYING:
            self._refuse(coming, Code.CONTROLLER_TIMED_OUT, f"to lay the path takes longer than {_LONGEST_LAYING:g} s")
        if goal is None:
            return
        if goal.ending is None:
            goal.waits = goal.unheard > 0 and (goal.waits or self._has_to_brake(goal, _speed(tick)))
            self._loop.wait_reason = _SILENT if goal.waits else ""
            goal.ending = self._verdict(goal, tick)
            if goal.ending is not None and goal.ending.outcome is not GoalOutcome.SUCCEEDED:
                self._loop.brake(goal.ending.words)
        if goal.ending is not None and self._stands(goal, tick):
            self._driven = None
            goal.end = goal.ending
            self._loop.release()
        elif tick.result is not None and goal.laid is not None:
            goal.progress = self._progress(goal, tick)

    def stop(self, why: str) -> None:
        """End all goals: the loop is no more."""
        for goal in (self._coming, self._driven):
            if goal is not None:
                self._close(goal, GoalOutcome.ABORTED, Code.UNKNOWN, why)
        self._coming = self._driven = None

    def _ask(self, goal: FollowGoal) -> None:
        loop, config = self._loop, self._config()
        whereabouts = loop.whereabouts()
        if whereabouts is None:
            self._refuse(goal, Code.TF_ERROR, loop.missing() or "the robot's pose is not known yet")
            return
        robot, twist = whereabouts
        goal.asked_at = loop.inbox.now
        limits = path_limits(config, self._gain(), self._settings)
        self._lay(
            (goal.poses, robot, twist, limits, self._settings, config),
            lambda laid: self._begin(goal, laid, twist[0]),
            lambda why: self._refuse(goal, _not_laid(why), why),
        )

    def _begin(self, goal: FollowGoal, laid: Laid | None, speed: float) -> None:
        if goal is not self._coming:
            return
        loop, farthest = self._loop, self._config().failure.max_position_error
        moving = abs(speed) > _STANDING
        if moving and loop.inbox.now - goal.asked_at > _OUTDATED:
            goal.outdated += 1
            if goal.outdated == _MOST_OUTDATED:
                self._give_up("a newer goal's path takes too long to prepare for a robot that moves")
            self._ask(goal)
            return
        if laid is None:
            self._stay(goal, moving)
            return
        if laid.begins > farthest:
            why = f"the path begins {laid.begins:.2f} m from the robot; the limit is {farthest:g} m"
            self._refuse(goal, Code.INVALID_PATH, f"{why} (failure.max_position_error)")
            return
        try:
            # A robot that moves has gone on meanwhile, and so has the reference that it is given.
            loop.follow(laid.reference, goal.asked_at if moving else None)
        except ValueError as error:
            code = Code.TF_ERROR if loop.missing() else Code.INVALID_PATH
            self._refuse(goal, code, str(error))
            return
        if self._driven is not None:
            self._driven.end = self._driven.ending or End(GoalOutcome.ABORTED, Code.NONE, "a newer goal took over")
        goal.laid, goal.since = laid, loop.inbox.now
        self._driven, self._coming = goal, None

    def _stay(self, goal: FollowGoal, moving: bool) -> None:
        """End a goal without a rest to drive: reached, if the robot stands there."""
        whereabouts = self._loop.whereabouts()
        if whereabouts is None:
            self._refuse(goal, Code.TF_ERROR, self._loop.missing() or "the robot's pose is not known")
            return
        gap = (math.inf, math.inf) if moving else _gap(whereabouts[0], goal.poses[-1])
        if not _within(gap, self._settings):
            self._refuse(goal, Code.INVALID_PATH, "path: it ends where the robot is, which does not stand there")
            return
        self._coming, self._loop.refusal = None, ""
        words = f"is there already, {gap[0]:.3f} m and {gap[1]:.3f} rad from the goal"
        self._close(goal, GoalOutcome.SUCCEEDED, Code.NONE, words)
        self._give_up("a newer goal took over")

    def _refuse(self, goal: FollowGoal, code: Code, why: str) -> None:
        if goal is not self._coming:
            return
        self._coming, self._loop.refusal = None, f"goal refused: {why}"
        self._close(goal, GoalOutcome.ABORTED, code, why)
        self._give_up(f"a newer goal could not be driven: {why}")

    def _give_up(self, why: str) -> None:
        """End the current drive."""
        if self._driven is not None and self._driven.ending is None:
            self._driven.ending = End(GoalOutcome.ABORTED, Code.NONE, why)
            self._loop.brake(why)

    def _close(self, goal: FollowGoal, outcome: GoalOutcome, code: Code, words: str) -> None:
        goal.end = End(outcome, code, words)

    def _verdict(self, goal: FollowGoal, tick: LoopTick) -> End | None:
        """Decide how a tick ends the goal; return None while it continues."""
        loop, settings, now = self._loop, self._settings, self._loop.inbox.now
        assert goal.laid is not None
        ours = loop.begun is not None and loop.begun.reference is goal.laid.reference
        goal.began = goal.began or ours
        if goal.cancelled:
            return End(GoalOutcome.CANCELED, Code.NONE, "cancelled")
        if self._is_abandoned(goal):
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, _ABANDONED)
        if tick.state is LoopState.FAULT:
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, tick.message)
        if goal.began and (not ours or tick.state is LoopState.IDLE):
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, "another reference was begun, or the node was reset")
        if not goal.began:
            late = now - goal.since > settings.follow_patience and not loop.held
            return End(GoalOutcome.ABORTED, Code.TF_ERROR, loop.missing() or "no pose arrives") if late else None
        if loop.blocked:
            return End(GoalOutcome.ABORTED, Code.FAILED_TO_MAKE_PROGRESS, tick.message or "blocked")
        result = tick.result
        if result is None or tick.state is LoopState.PAUSED or loop.held or goal.waits:
            goal.since = now
            return None
        if result.mode is Mode.FINISHED:
            return None if tick.command.any() else self._arrived(goal, tick)
        if result.mode is Mode.TRACKING:
            goal.since = now
        if now - goal.since <= settings.follow_patience:
            return None
        return End(GoalOutcome.ABORTED, self._code(tick), tick.message or "no command could be found")

    def _has_to_brake(self, goal: FollowGoal, speed: float) -> bool:
        """Return True if the robot, at `speed` [m/s], has to brake now to keep the distance without its client."""
        if goal.blind_since != goal.heard_at:
            goal.blind_since, goal.blind_distance = goal.heard_at, 0.0
        config = self._config()
        goal.blind_distance += speed * config.sample_time
        stop = speed * _REACTION + 0.5 * speed**2 / config.limits.v_braking
        return self._silence(goal) > _SILENCE and goal.blind_distance + stop > self._settings.follow_blind_distance

    def _is_abandoned(self, goal: FollowGoal) -> bool:
        return self._silence(goal) > _LONGEST_SILENCE

    def _silence(self, goal: FollowGoal) -> float:
        """Return the time since the client was heard [s]; zero until several checks have failed."""
        if goal.unheard < _SILENT_CHECKS or not self._settings.follow_blind_distance:
            return 0.0
        return time.monotonic() - goal.heard_at

    def _arrived(self, goal: FollowGoal, tick: LoopTick) -> End:
        assert tick.result is not None
        settings, estimate = self._settings, tick.result.estimate
        if estimate is None:
            return End(GoalOutcome.ABORTED, Code.TF_ERROR, "at the end of the path the robot's pose is not known")
        gap = _gap(estimate.pose, goal.poses[-1])
        words = f"{gap[0]:.3f} m and {gap[1]:.3f} rad from the goal"
        if _within(gap, settings):
            assert goal.laid is not None
            note = f"; {goal.laid.note}" if goal.laid.note else ""
            return End(GoalOutcome.SUCCEEDED, Code.NONE, f"arrived, {words}{note}")
        return End(GoalOutcome.ABORTED, Code.FAILED_TO_MAKE_PROGRESS, f"the path has ended {words}")

    def _code(self, tick: LoopTick) -> Code:
        """Return the code for a robot that does not drive."""
        assert tick.result is not None
        inbox = self._loop.inbox
        if inbox.odometry.fault(inbox.now, self._settings.odom_timeout) or tick.result.estimate is None:
            return Code.TF_ERROR
        if "no pose was accepted" in tick.message:
            return Code.TF_ERROR
        if tick.result.mode is Mode.REUSED_PLAN or "no way" in tick.message or "from the reference" in tick.message:
            return Code.NO_VALID_CONTROL
        return Code.PATIENCE_EXCEEDED

    def _stands(self, goal: FollowGoal, tick: LoopTick) -> bool:
        """Return True if the robot is known to be at rest."""
        now = self._loop.inbox.now
        if tick.command.any():
            goal.since = now
            return False
        estimate = None if tick.result is None else tick.result.estimate
        still = estimate is not None and float(np.abs(estimate.twist).max()) <= _STANDING
        return still or tick.state in (LoopState.FAULT, LoopState.IDLE) or now - goal.since > _SETTLES

    def _progress(self, goal: FollowGoal, tick: LoopTick) -> tuple[float, float] | None:
        result, begun = tick.result, self._loop.begun
        assert result is not None
        assert goal.laid is not None
        reference = goal.laid.reference
        if result.estimate is None or begun is None or begun.reference is not reference:
            return goal.progress
        time = self._loop.inbox.now - begun.t0 - result.reference_delay
        done, whole = reference.sample([time, reference.duration]).arc_length.tolist()
        error = tracking_error(result)
        ahead = error[0] if error is not None else 0.0
        return max(0.0, whole - done - ahead), abs(float(result.estimate.twist[0]))
