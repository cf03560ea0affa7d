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

HOLD_MESSAGE = "held; call hold with false to release"

# Minimum motion of a frame that moves its reference: displacement at the robot [m] plus rotation [rad].
_MIN_FRAME_MOTION = 1e-4
# Minimum shift in time [s], or displacement [m] plus rotation [rad], after which the reference is published again.
_MIN_SHIFT, _MIN_MOTION = 0.2, 0.02


class LoopState(StrEnum):
    """State of an active node."""

    IDLE = "IDLE"
    """The command is zero; `start` starts a drive."""
    DRIVING = "DRIVING"
    """The controller computes the command."""
    PAUSED = "PAUSED"
    """The controller brakes to a standstill; `start` resumes the drive."""
    FAULT = "FAULT"
    """The command is zero after an exception; `start` starts a new drive."""


_SOLVE_SHARE = 0.5
"""Time limit of a solve as a share of the sample time [-], if `solver.time_limit` is not set.

The rest of the sample time is for the other work of a tick.
"""


class RefusedError(DiffdriveMpcError, ValueError):
    """Request that cannot be granted in the current state; the message contains the reason and the remedy."""


@dataclass(frozen=True)
class Request:
    """Inputs of the controller at `time` [s]; `number` counts the calls of the controller from 1."""

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
        Controller that has not been started.
    settings
        Settings of the node.
    inbox
        Source of the measurements; the controller uses its clock.
    trajectory
        Initial reference; None if there is no reference.
    in_sim_time
        True if the node's clock measures the period; False if the computer's clock measures it.
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
    stop_reason
        Reason why the robot must not drive; empty if it may drive. The robot brakes as with outdated odometry.
    wait_reason
        Reason for a temporary stop that is not a failure; empty if the robot may drive. The state does not change.
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
        self._starts_at_robot = settings.start_at_robot
        self._pending_drive: tuple[Reference, float | None] | None = None
        self._previous: tuple[Reference | None, Placement | None, bool] | None = None
        self.blocked = False
        self.drive: Drive | None = None
        self.held = held
        self.stop_reason = self.warning = self.refusal = self.wait_reason = self._end_reason = ""
        self._published: tuple[Drive, PublishedReference] | None = None
        self._requests = 0
        # The node resets the controller at its activation.
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

    def set_reference(self, reference: Reference, placement: Placement | None = None) -> None:
        """Set the reference for the next start; it is used immediately if the robot drives.

        If `drive_on_reference` is set, an idle robot starts to drive. `placement` is the placement of a reference in a
        frame that differs from the control frame; the reference then moves with its frame.

        Raises
        ------
        ValueError
            If the reference exceeds the speed limits, the position of its frame is unknown, or the robot waits after a
            failure.
        """
        if self._is_latched:
            raise RefusedError("the robot stopped after a failure: call start or resume before a new reference")
        if placement is not None:
            # This call raises an error for an unknown frame before the state changes.
            placement.motion()
        self._check(reference)
        # A reference with a frame is not moved to the robot.
        self._reference, self._placement, self._starts_at_robot, self.refusal = reference, placement, False, ""
        if self.state is LoopState.DRIVING:
            self._pending_drive = self._previous = None
            self._start_controller(reference, self.inbox.now)
        elif self._settings.drive_on_reference and self.state is LoopState.IDLE:
            self._start_when_ready = True

    def follow(self, reference: Reference, t0: float | None = None) -> None:
        """Drive along `reference` until `release`; in any state, the drive starts at the next tick with a pose.

        Parameters
        ----------
        reference
            Reference in the control frame; it is not moved to the robot.
        t0
            Time 0 of the reference on the controller's clock [s]; None for the tick at which the drive starts.

        Raises
        ------
        ValueError
            If measurements are missing, or the reference exceeds the speed limits.
        """
        fault = self.drive_fault()
        if fault:
            raise RefusedError(fault)
        self._check(reference)
        self._pending_drive, self.refusal = (reference, t0), ""

    def brake(self, reason: str) -> None:
        """Brake to a standstill in any state of the loop, and cancel a pending start."""
        self._pending_drive, self._start_when_ready = None, False
        if self.state in (LoopState.DRIVING, LoopState.PAUSED):
            self.state, self._reason = LoopState.PAUSED, reason

    def brake_permanently(self, reason: str) -> None:
        """Brake to a standstill; later requests do not move the robot."""
        self._end_reason = reason

    @property
    def is_moving(self) -> bool:
        """True if the last command was not zero."""
        return self.last is not None and bool(self.last.command.any())

    def release(self) -> None:
        """Return to IDLE after `follow` and restore the previous reference; the state FAULT remains."""
        self._pending_drive, self._start_when_ready, self.blocked = None, False, False
        self.wait_reason = self.shortfall = ""
        if self._previous is not None:
            (self._reference, self._placement, self._starts_at_robot), self._previous = (
                self._previous,
                None,
            )
        if self.state is not LoopState.FAULT:
            self.state, self._reason = LoopState.IDLE, ""

    def pose_and_twist(self) -> tuple[FloatArray, tuple[float, float]] | None:
        """Return pose (3,) and twist v, omega [m/s, rad/s] of the robot; None if they are unknown."""
        if self.drive_fault():
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
        action = f"starts '{self._reference.name}', {self._reference.duration:.1f} s{self._hold_note()}"
        return "; ".join(filter(None, [action, self.shortfall]))

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
        """Brake to a standstill while the reference waits; return a description of the action.

        Raises RefusedError if the robot is not driving.
        """
        if self._start_when_ready or (self._pending_drive is not None and self.state is not LoopState.DRIVING):
            self._start_when_ready, self._pending_drive = False, None
            return "start cancelled"
        if self.state is not LoopState.DRIVING:
            raise RefusedError(f"the robot is not driving ({self.state})")
        self.state, self._reason, self._pending_drive = LoopState.PAUSED, reason, None
        return "brakes"

    def hold(self, *, on: bool) -> str:
        """Hold the robot if `on` is True, otherwise release it; return a description of the action.

        A held robot brakes to a standstill in any state of the loop.
        """
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
        self._pending_drive, self.blocked = None, False
        return "reset; call start to drive"

    def tick(self) -> LoopTick:
        """Compute the next command; after an exception the command is zero and the state is FAULT."""
        start = time.perf_counter()
        self.times.start_tick(self._steady())
        try:
            tick = self._run_tick(self.inbox.now)
        except Exception as error:  # the robot must stop after every error
            self.state, self._reason = LoopState.FAULT, f"{type(error).__name__}: {error}; call start to restart"
            tick = self._idle_tick()
        self.last = tick
        age = self.inbox.odometry.age(self.inbox.now)
        self.times.end(time.perf_counter() - start, age if np.isfinite(age) else None)
        return tick

    def reference_to_publish(self) -> PublishedReference | None:
        """Return the reference and its start time if they must be published, else None.

        They are published at the start of a drive, and again after the reference has waited or its frame has moved.
        """
        drive, last = self.drive, self.last
        if drive is None or last is None:
            return None
        if self._published is None or self._published[0] is not drive:
            self._published = drive, PublishedReference(drive.reference, drive.t0)
            return self._published[1]
        published, reference = self._published[1], self._moved_reference or drive.reference
        # Only intended delays, such as a hold or a speed limit, shift the published reference; lag remains an error.
        t0 = drive.t0 + self._controller.planned_delay
        is_tracking, is_moved = last.mode in (Mode.TRACKING, Mode.REUSED_PLAN), self._is_moved(published, reference)
        if not is_tracking or (abs(t0 - published.t0) < _MIN_SHIFT and not is_moved):
            return None
        self._published = drive, PublishedReference(reference, t0)
        return self._published[1]

    def _is_moved(self, published: PublishedReference, reference: Reference) -> bool:
        """Return True if the frame has moved far enough since `published` to publish `reference` again."""
        pose, previous = self.inbox.newest_pose, published.reference
        if pose is None or not (isinstance(previous, MovedReference) and isinstance(reference, MovedReference)):
            return False
        return _motion_difference(previous.motion, reference.motion, pose.value) > _MIN_MOTION

    def _run_tick(self, t: float) -> LoopTick:
        # The start conditions below require the newest pose.
        self.inbox.look_up_pose()
        if self._start_when_ready and self._reference is not None and not self._start_fault():
            self._start_when_ready = False
            self._start_controller(self._reference, t)
            self.state = LoopState.DRIVING
        if self._pending_drive is not None and self.inbox.has_pose and not self.drive_fault():
            self._start_pending_drive(t)
        if self.state in (LoopState.IDLE, LoopState.FAULT):
            return self._idle_tick()
        self._move_with_frame()
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
        """Return the deadline of the solve [s, `time.monotonic`]; None in simulated time, since the clock waits."""
        if self._in_sim_time:
            return None
        config = self._controller.config
        return time.monotonic() + (config.solver.time_limit or _SOLVE_SHARE * config.sample_time)

    def _start_pending_drive(self, t: float) -> None:
        assert self._pending_drive is not None
        (reference, t0), self._pending_drive = self._pending_drive, None
        if self.state is LoopState.FAULT:
            self._reset_controller()
        # Consecutive goals restore the reference before the first goal.
        if self._previous is None:
            self._previous = (self._reference, self._placement, self._starts_at_robot)
        self._reference, self._placement, self._starts_at_robot = reference, None, False
        self._start_controller(reference, t if t0 is None else t0)
        self.state, self._reason, self.blocked, self._start_when_ready = LoopState.DRIVING, "", False, False

    def _hold(self, t: float) -> Hold | None:
        """Return the hold with the highest priority at `t` [s]; None if the robot may drive."""
        if self._end_reason:
            return Hold(self._end_reason)
        if self.state is LoopState.PAUSED:
            return Hold(self._reason)
        outage = self.inbox.odometry.fault(t, self._settings.odom_timeout)
        max_age = self._controller.config.failure.resume_within
        # A long outage of odometry takes precedence over a hold. A hold is not a failure, so the robot would otherwise
        # continue by itself after the release of the hold.
        if outage and not -max_age <= self.inbox.odometry.age(t) <= max_age:
            return Hold(outage, failure=True, waits=True)
        if self.held:
            return Hold(HOLD_MESSAGE)
        if self.wait_reason:
            return Hold(self.wait_reason)
        fault = self.stop_reason or outage or self._frame_fault
        return Hold(fault, failure=True) if fault else None

    def _move_with_frame(self) -> None:
        """Move the reference with its frame; if the position of the frame is unknown, store the fault."""
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
        reason = self._reason or (self._start_fault() if self._start_when_ready else "")
        return LoopTick(np.zeros(2), self.state, "; ".join(filter(None, [reason, HOLD_MESSAGE * self.held])))

    def _start_fault(self) -> str:
        """Return the reason why a drive cannot start; empty if it can start."""
        fault = self.drive_fault()
        if not fault and self._reference is None:
            fault = "there is no reference: set the parameter trajectory, or publish one"
        if not fault and self._placement is not None:
            try:
                self._placement.motion()
            except ValueError as error:
                fault = str(error)
        return fault

    def drive_fault(self) -> str:
        """Return `stop_reason` or the missing measurement that prevents driving; empty if the robot may drive."""
        inbox = self.inbox
        fault = self.stop_reason or inbox.odometry.fault(inbox.now, self._settings.odom_timeout)
        if not fault and self._settings.poses_from != "odometry":
            fault = inbox.pose.fault(inbox.now, self._controller.config.failure.max_pose_age)
        return fault

    def _require_inputs(self) -> None:
        fault = self._start_fault()
        if fault:
            raise RefusedError(fault)

    def _check(self, reference: Reference) -> None:
        config = self._controller.config
        check_speeds(reference, config.limits, config.sample_time, self._controller.model.dc_gain)
        self.shortfall = str(self._controller.find_shortfall(reference, is_moving=self.is_moving) or "")

    def _start_controller(self, reference: Reference, t0: float) -> None:
        pose = self.inbox.newest_pose
        self._moved_reference = None
        if self._placement is not None:
            reference = self._moved_reference = MovedReference(reference, self._placement.motion())
        elif self._starts_at_robot and pose is not None:
            reference = starting_at(reference, pose.value)
        # A planner may send a new path every second, so a replacement must preserve the learned slip.
        continues = self.state is LoopState.DRIVING and self.last is not None and self.last.mode is Mode.TRACKING
        if continues:
            self._controller.switch_reference(reference, t0)
        else:
            self._controller.start(reference, t0)
        self.drive = Drive(reference, t0, self._was_reset, continues)

    def _reset_controller(self) -> None:
        self._controller.reset()
        self._was_reset = True


def _motion_difference(first: FloatArray, second: FloatArray, pose: ArrayLike) -> float:
    """Compute the difference of two motions of a frame at `pose` (3,): displacement [m] plus rotation [rad]."""
    (ax, ay, a), (bx, by, b) = first, second
    start = np.asarray(pose, dtype=float)
    x, y = start[0] - ax, start[1] - ay
    # The pose is moved back by the first motion, and then forward by the second motion.
    x, y = math.cos(a) * x + math.sin(a) * y, -math.sin(a) * x + math.cos(a) * y
    end = bx + math.cos(b) * x - math.sin(b) * y, by + math.sin(b) * x + math.cos(b) * y
    return math.hypot(end[0] - start[0], end[1] - start[1]) + abs(math.remainder(b - a, math.tau))
