"""Control loop of the node, independent of rclpy: the tick, and start, pause and reset of a drive."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.latency import LoopTimes
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.transforms.frames import Placement
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories.moved import MovedReference, starting_at
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds

HELD = "held; call hold with false to release"

# Minimum motion of a frame with which the reference is moved: displacement at the robot [m] plus rotation [rad].
_MIN_FRAME_MOTION = 1e-4

# Minimum shift of the reference in time [s], or in position [m] plus rotation [rad], after which it is published again.
_MIN_SHIFT, _MIN_MOTION = 0.2, 0.02


class LoopState(StrEnum):
    """State of an active node."""

    IDLE = "IDLE"
    """The command is zero; `start` starts a drive."""
    DRIVING = "DRIVING"
    """The controller computes the command."""
    PAUSED = "PAUSED"
    """The controller brakes and stands; `start` resumes the drive."""
    FAULT = "FAULT"
    """The command is zero after an exception; `start` starts a new drive."""


_SHARE_OF_TICK = 0.5
"""Time limit of a solve as a share of the sample time [-], if `solver.time_limit` is not set.

The rest of the sample time is for the other work of a tick.
"""


class RefusedError(DiffdriveMpcError, ValueError):
    """Request that cannot be granted in the current state; the message contains the reason and the remedy."""


@dataclass(frozen=True)
class Request:
    """Inputs of the controller at `time` [s]; `number` is the number of the call, from 1."""

    number: int
    time: float
    measurement: Measurement
    hold: Hold | None


@dataclass(frozen=True)
class Drive:
    """Drive of the controller along a reference.

    Attributes
    ----------
    reference
        Reference in the control frame.
    t0
        Time 0 of the reference on the controller's clock [s].
    reset
        True if the controller was reset before the drive.
    continues
        True if the reference replaced another reference while driving and the controller kept its state.
    """

    reference: Reference
    t0: float
    reset: bool
    continues: bool = False


@dataclass(frozen=True)
class PublishedReference:
    """Tracked reference, and its time 0 on the controller's clock [s], which increases while the reference waits."""

    reference: Reference
    t0: float


@dataclass(frozen=True)
class LoopTick:
    """Result of one tick.

    Attributes
    ----------
    command
        (2,) v [m/s], omega [rad/s] to be sent.
    state
        State of the loop.
    message
        Reason for the command; empty in normal operation.
    result
        Step result of the controller; None if the controller was not called.
    request
        Inputs of the controller; None if the controller was not called.
    """

    command: FloatArray
    state: LoopState
    message: str
    result: StepResult | None = None
    request: Request | None = None

    @property
    def mode(self) -> str:
        """Mode of the controller; state of the loop if the controller was not called."""
        return str(self.state if self.result is None else self.result.mode)


class ControlLoop:
    """Control loop that calls the controller once per tick.

    Parameters
    ----------
    controller
        A newly built controller.
    settings
        Settings of the node.
    inbox
        Source of the measurements; the controller uses its clock.
    trajectory
        Initial reference; None if there is no reference.
    in_sim_time
        True if the node's clock measures the period, False if the computer's clock does.
    held
        True if the loop starts with a hold, see `hold`.

    Attributes
    ----------
    state
        State of the loop; a hold does not change it.
    held
        True if a hold prevents the robot from moving, independent of the state.
    drive
        Current drive; None before the first drive.
    objection
        Reason why the robot must not drive; empty if it may drive. The robot brakes as for stale odometry.
    wait_reason
        Reason why the robot temporarily brakes and stands without a failure; empty if it may drive. The state does not
        change.
    frame_shifts
        Number of times that the current reference was moved together with its frame.
    warning
        Other warnings for diagnostics.
    refusal
        Reason why the last reference or goal was refused, for diagnostics; empty if it was accepted.
    shortfall
        Description of the limits that the last accepted reference exceeds; empty if it is feasible.
    blocked
        True if the loop is paused because the robot was blocked.
    """

    def __init__(
        self,
        controller: Controller,
        settings: NodeSettings,
        inbox: Inbox,
        trajectory: Reference | None,
        *,
        in_sim_time: bool,
        held: bool = False,
    ) -> None:
        self._controller, self._settings, self.inbox = controller, settings, inbox
        self._steady: Callable[[], float] = (lambda: self.inbox.now) if in_sim_time else time.perf_counter
        self._in_sim_time = in_sim_time
        self.times = LoopTimes(controller.config.sample_time, settings.statistics_window)
        self.state = LoopState.IDLE
        self.fallbacks = 0
        self._reason = ""
        self._start_when_ready = settings.drive_on_activate
        self._reference = trajectory
        self._placement: Placement | None = None
        self._moved_reference: MovedReference | None = None
        self._frame_fault = ""
        self.frame_shifts = 0
        self._moves_to_robot = settings.start_at_robot
        self._followed: tuple[Reference, float | None] | None = None
        self._saved: tuple[Reference | None, Placement | None, bool] | None = None
        self.blocked = False
        self.drive: Drive | None = None
        self.held = held
        self.objection = self.warning = self.refusal = self.wait_reason = self._end_reason = ""
        self._published: tuple[Drive, PublishedReference] | None = None
        self._requests = 0
        # A newly activated node counts as reset.
        self._was_reset = True
        self.last: LoopTick | None = None
        self.shortfall = "" if trajectory is None else str(controller.find_shortfall(trajectory) or "")

    @property
    def reference(self) -> Reference | None:
        """Current reference, or the reference of the next start; None if there is no reference."""
        return self._reference

    @property
    def speed_limit(self) -> float | None:
        """External speed limit [m/s]; None if there is no limit."""
        return self._controller.speed_limit

    def offer(self, reference: Reference, placement: Placement | None = None) -> None:
        """Set the reference for the next start; it is used immediately if the robot drives.

        If `drive_on_reference` is set, an idle robot starts to drive. With `placement`, the reference is given in a
        frame other than the control frame, and it moves with this frame.

        Raises
        ------
        ValueError
            If the reference exceeds the speed limits, the position of its frame is unknown, or the robot waits after a
            failure.
        """
        if self._is_latched:
            raise RefusedError("the robot stopped after a failure: call start or resume before a new reference")
        if placement is not None:
            # Raises for an unknown frame before anything is changed.
            placement.motion()
        self._check(reference)
        # A reference with a frame is not moved to the robot.
        self._reference, self._placement, self._moves_to_robot, self.refusal = reference, placement, False, ""
        if self.state is LoopState.DRIVING:
            self._followed = self._saved = None
            self._start_controller(reference, self.inbox.now)
        elif self._settings.drive_on_reference and self.state is LoopState.IDLE:
            self._start_when_ready = True

    def follow(self, reference: Reference, t0: float | None = None) -> None:
        """Drive along `reference` until `release`; the drive starts at the next tick with a pose, in any state.

        Parameters
        ----------
        reference
            Reference, which is not moved to the robot.
        t0
            Time 0 of the reference on the controller's clock [s]; None for the tick at which the drive starts.

        Raises
        ------
        ValueError
            If measurements are missing, or the reference exceeds the speed limits.
        """
        missing = self.missing()
        if missing:
            raise RefusedError(missing)
        self._check(reference)
        self._followed, self.refusal = (reference, t0), ""

    def brake(self, reason: str) -> None:
        """Brake and stand in any state of the loop, and cancel a pending start."""
        self._followed, self._start_when_ready = None, False
        if self.state in (LoopState.DRIVING, LoopState.PAUSED):
            self.state, self._reason = LoopState.PAUSED, reason

    def end(self, reason: str) -> None:
        """Brake and stand permanently; later requests do not move the robot."""
        self._end_reason = reason

    @property
    def is_moving(self) -> bool:
        """True if the last command was not zero."""
        return self.last is not None and bool(self.last.command.any())

    def release(self) -> None:
        """Return to IDLE after `follow` and restore the previous reference; the state FAULT remains."""
        self._followed, self._start_when_ready, self.blocked = None, False, False
        self.wait_reason = self.shortfall = ""
        if self._saved is not None:
            (self._reference, self._placement, self._moves_to_robot), self._saved = self._saved, None
        if self.state is not LoopState.FAULT:
            self.state, self._reason = LoopState.IDLE, ""

    def pose_and_twist(self) -> tuple[FloatArray, tuple[float, float]] | None:
        """Return pose (3,) and twist v, omega [m/s, rad/s] of the robot, or None if they are unknown."""
        if self.missing():
            return None
        result = None if self.last is None else self.last.result
        if result is not None and result.estimate is not None:
            return result.estimate.pose.copy(), (float(result.estimate.twist[0]), float(result.estimate.twist[1]))
        pose = self.inbox.newest_pose
        return None if pose is None else (np.array(pose.value, dtype=float), (0.0, 0.0))

    def start(self) -> str:
        """Start to drive at the next tick, or resume after a pause; return a description of the action.

        Raises
        ------
        ValueError
            If the robot already drives, measurements are missing, or there is no reference within the limits.
        """
        if self.state is LoopState.PAUSED:
            return self.resume()
        has_stopped = self.last is not None and self.last.mode in (Mode.FINISHED, Mode.STOPPED)
        if self.state is LoopState.DRIVING and not has_stopped:
            raise RefusedError("the robot is already driving; pause it first")
        self._require_inputs()
        assert self._reference is not None
        self._check(self._reference)
        if self.state is LoopState.FAULT:
            self._reset_controller()
        self.state, self._reason, self._start_when_ready = LoopState.IDLE, "", True
        starts = f"starts '{self._reference.name}', {self._reference.duration:.1f} s{self._hold_note()}"
        return "; ".join(filter(None, [starts, self.shortfall]))

    def resume(self) -> str:
        """Resume the current reference after a pause or a failure; return a description of the action.

        Raises
        ------
        ValueError
            If no drive can be resumed, or measurements are missing.
        """
        if self.state is not LoopState.PAUSED and not self._is_latched:
            raise RefusedError(f"there is no drive to resume ({self.state}); call start to drive")
        self._require_inputs()
        self._controller.resume()
        self.state, self._reason, self.blocked = LoopState.DRIVING, "", False
        return f"resumed{self._hold_note()}"

    @property
    def _is_latched(self) -> bool:
        """True while a drive that stopped after a failure waits for `start` or `resume`."""
        return self.state is LoopState.DRIVING and self._controller.is_latched

    def pause(self, reason: str = "paused; call start to drive on") -> str:
        """Brake and stand while the reference waits; return a description of the action.

        Raises RefusedError if the robot is not driving.
        """
        if self._start_when_ready or (self._followed is not None and self.state is not LoopState.DRIVING):
            self._start_when_ready, self._followed = False, None
            return "start cancelled"
        if self.state is not LoopState.DRIVING:
            raise RefusedError(f"the robot is not driving ({self.state})")
        self.state, self._reason, self._followed = LoopState.PAUSED, reason, None
        return "brakes"

    def hold(self, *, on: bool) -> str:
        """Brake and stand while `on` is True, in any state of the loop; return a description of the action."""
        was_held, self.held = self.held, on
        if on:
            return "is held already" if was_held else "is held; brakes" if self.is_moving else "is held"
        if not was_held:
            return "was not held"
        if self._is_latched:
            return "released; stands after a failure; call start or resume to drive"
        if self.state is LoopState.DRIVING:
            return "released; the drive continues"
        action = "starts when possible" if self._start_when_ready else "stands; call start to drive"
        return f"released; {action} ({self.state})"

    def reset(self) -> str:
        """Reset estimate, measurements and progress; return a description of the action.

        Raises RefusedError if the robot moves.
        """
        if self.is_moving:
            raise RefusedError("the robot is still driving; pause first")
        self._reset_controller()
        self.inbox.restart()
        self.state, self._reason, self._start_when_ready, self.drive = LoopState.IDLE, "", False, None
        self._followed, self.blocked = None, False
        return "reset; call start to drive"

    def tick(self) -> LoopTick:
        """Compute the next command; after an exception the command is zero and the state is FAULT."""
        start = time.perf_counter()
        self.times.start_tick(self._steady())
        try:
            tick = self._decide(self.inbox.now)
        except Exception as error:  # the robot must stop after any error
            self.state, self._reason = LoopState.FAULT, f"{type(error).__name__}: {error}; call start to restart"
            tick = self._idle_tick()
        self.last = tick
        age = self.inbox.odometry.age(self.inbox.now)
        self.times.end(time.perf_counter() - start, age if np.isfinite(age) else None)
        return tick

    def reference_to_publish(self) -> PublishedReference | None:
        """Return the reference and its start time if they must be published, else None.

        They are published at the start of a drive, after the reference has waited, and after its frame has moved.
        """
        drive, last = self.drive, self.last
        if drive is None or last is None:
            return None
        if self._published is None or self._published[0] is not drive:
            self._published = drive, PublishedReference(drive.reference, drive.t0)
            return self._published[1]
        published, reference = self._published[1], self._moved_reference or drive.reference
        # Only decided delays, such as a hold or a speed limit, move the published reference; lag stays an error.
        t0 = drive.t0 + self._controller.planned_delay
        drives = last.mode in (Mode.TRACKING, Mode.REUSED_PLAN)
        if not drives or (abs(t0 - published.t0) < _MIN_SHIFT and not self._is_moved(published.reference, reference)):
            return None
        self._published = drive, PublishedReference(reference, t0)
        return self._published[1]

    def _is_moved(self, published: Reference, reference: Reference) -> bool:
        """Return True if the frame has moved far enough since `published` to publish `reference` again."""
        pose = self.inbox.newest_pose
        if pose is None or not (isinstance(published, MovedReference) and isinstance(reference, MovedReference)):
            return False
        return _motion_difference(published.motion, reference.motion, pose.value) > _MIN_MOTION

    def _decide(self, t: float) -> LoopTick:
        # First, since the conditions of a start below need the newest pose.
        self.inbox.look_up_pose()
        if self._start_when_ready and self._reference is not None and not self._missing():
            self._start_when_ready = False
            self._start_controller(self._reference, t)
            self.state = LoopState.DRIVING
        if self._followed is not None and self.inbox.has_pose and not self.missing():
            self._start_followed(t)
        if self.state in (LoopState.IDLE, LoopState.FAULT):
            return self._idle_tick()
        self._follow_frame()
        self._requests += 1
        request = Request(self._requests, t, self.inbox.measurement(), self._hold(t))
        result = self._controller.step(t, request.measurement, request.hold, deadline=self._deadline())
        self._was_reset = False
        self.fallbacks += result.mode in (Mode.REUSED_PLAN, Mode.BRAKING)
        if self.state is LoopState.DRIVING and result.blocked_for >= self._settings.blocked_timeout:
            self.pause(f"blocked for {result.blocked_for:.1f} s; clear the way and call start")
            self.blocked = True
        return LoopTick(result.command, self.state, result.message, result, request)

    def _deadline(self) -> float | None:
        """Return the deadline of the solve [s, `time.monotonic`]; None in simulated time, which waits for the solve."""
        if self._in_sim_time:
            return None
        config = self._controller.config
        return time.monotonic() + (config.solver.time_limit or _SHARE_OF_TICK * config.sample_time)

    def _start_followed(self, t: float) -> None:
        assert self._followed is not None
        (reference, t0), self._followed = self._followed, None
        if self.state is LoopState.FAULT:
            self._reset_controller()
        # Of several goals in a row, only the first replaces the reference to be restored.
        if self._saved is None:
            self._saved = (self._reference, self._placement, self._moves_to_robot)
        self._reference, self._placement, self._moves_to_robot = reference, None, False
        self._start_controller(reference, t if t0 is None else t0)
        self.state, self._reason, self.blocked, self._start_when_ready = LoopState.DRIVING, "", False, False

    def _hold(self, t: float) -> Hold | None:
        if self._end_reason:
            return Hold(self._end_reason)
        if self.state is LoopState.PAUSED:
            return Hold(self._reason)
        silence = self.inbox.odometry.fault(t, self._settings.odom_timeout)
        within = self._controller.config.failure.resume_within
        # A long silence takes precedence over a hold, which is no failure: the robot must not continue by itself when
        # the hold is released.
        if silence and not -within <= self.inbox.odometry.age(t) <= within:
            return Hold(silence, failure=True, waits=True)
        if self.held:
            return Hold(HELD)
        if self.wait_reason:
            return Hold(self.wait_reason)
        fault = self.objection or silence or self._frame_fault
        return Hold(fault, failure=True) if fault else None

    def _follow_frame(self) -> None:
        """Move the reference with its frame; an unknown position of the frame is a fault that stops the robot."""
        self._frame_fault = ""
        if self._placement is None or self._moved_reference is None:
            return
        try:
            motion = self._placement.motion()
        except ValueError as error:
            self._frame_fault = str(error)
            return
        pose = self.inbox.newest_pose
        if pose is None or _motion_difference(self._moved_reference.motion, motion, pose.value) <= _MIN_FRAME_MOTION:
            return
        self._moved_reference = MovedReference(self._moved_reference.original, motion)
        self._controller.switch_reference(self._moved_reference)
        self.frame_shifts += 1

    def _hold_note(self) -> str:
        return " after the release of the hold" if self.held else ""

    def _idle_tick(self) -> LoopTick:
        waiting = self._missing() if self._start_when_ready else ""
        return LoopTick(np.zeros(2), self.state, "; ".join(filter(None, [self._reason or waiting, HELD * self.held])))

    def _missing(self) -> str:
        """Return the condition for a start that is not satisfied; empty if all conditions are satisfied."""
        fault = self.missing()
        if not fault and self._reference is None:
            fault = "there is no reference: set the parameter trajectory, or publish one"
        if not fault and self._placement is not None:
            try:
                self._placement.motion()
            except ValueError as error:
                fault = str(error)
        return fault

    def missing(self) -> str:
        """Return the missing measurement or the objection to driving; empty if the robot may drive."""
        inbox = self.inbox
        fault = self.objection or inbox.odometry.fault(inbox.now, self._settings.odom_timeout)
        if not fault and self._settings.poses_from != "odometry":
            fault = inbox.pose.fault(inbox.now, self._controller.config.failure.max_pose_age)
        return fault

    def _require_inputs(self) -> None:
        missing = self._missing()
        if missing:
            raise RefusedError(missing)

    def _check(self, reference: Reference) -> None:
        config = self._controller.config
        check_speeds(reference, config.limits, config.sample_time, self._controller.model.dc_gain)
        self.shortfall = str(self._controller.find_shortfall(reference, is_moving=self.is_moving) or "")

    def _start_controller(self, reference: Reference, t0: float) -> None:
        pose = self.inbox.newest_pose
        self._moved_reference = None
        if self._placement is not None:
            reference = self._moved_reference = MovedReference(reference, self._placement.motion())
        elif self._moves_to_robot and pose is not None:
            reference = starting_at(reference, pose.value)
        # A planner may send a new path every second, so the learned slip must be preserved.
        continues = self.state is LoopState.DRIVING and self.last is not None and self.last.mode is Mode.TRACKING
        if continues:
            self._controller.switch_reference(reference, t0)
        else:
            self._controller.start(reference, t0)
        self.drive = Drive(reference, t0, self._was_reset, continues)

    def _reset_controller(self) -> None:
        self._controller.reset()
        self._was_reset = True


def _motion_difference(before: FloatArray, after: FloatArray, pose: ArrayLike) -> float:
    """Compute the change of a frame's motion at `pose` (3,): displacement [m] plus rotation [rad]."""
    (ax, ay, a), (bx, by, b) = before, after
    start = np.asarray(pose, dtype=float)
    x, y = start[0] - ax, start[1] - ay
    # Undo the motion `before`, then apply the motion `after`.
    x, y = math.cos(a) * x + math.sin(a) * y, -math.sin(a) * x + math.cos(a) * y
    end = bx + math.cos(b) * x - math.sin(b) * y, by + math.sin(b) * x + math.cos(b) * y
    return math.hypot(end[0] - start[0], end[1] - start[1]) + abs(math.remainder(b - a, math.tau))
