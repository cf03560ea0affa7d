"""The control loop: the steps of one tick of the node, and start, pause and reset of a drive. Needs no ROS itself."""

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

HELD = "held; call hold with false to let go"

# A frame that moved by less counts as unmoved: displacement at the robot [m], with a radian counted as a metre.
_STAYS = 1e-4

# Shift of the reference in time [s] or place [m, rad] from which it is published again.
_TELL_DELAY, _TELL_MOTION = 0.2, 0.02


class LoopState(StrEnum):
    """State of an active node."""

    IDLE = "IDLE"
    """Commands zero and waits for `start`."""
    DRIVING = "DRIVING"
    """The controller decides."""
    PAUSED = "PAUSED"
    """The controller brakes and stands; `start` drives on."""
    FAULT = "FAULT"
    """Commands zero after an exception; `start` starts again."""


_SHARE_OF_TICK = 0.5
"""Share of the sample time after which a solve has to end, unless `solver.time_limit` states it: the rest of a tick
needs time, too [-].
"""


class RefusedError(DiffdriveMpcError, ValueError):
    """A request that cannot be granted now; contains the reason and the remedy."""


@dataclass(frozen=True)
class Request:
    """Inputs of the controller at `time` [s]; `number` counts its calls so far, this one included."""

    number: int
    time: float
    measurement: Measurement
    hold: Hold | None


@dataclass(frozen=True)
class Begun:
    """A start of the controller: the reference as placed, its time 0 [s], and whether a reset came before.

    With `goes_on`, the reference replaced another one while driving, and the controller kept its state.
    """

    reference: Reference
    t0: float
    reset: bool
    goes_on: bool = False


@dataclass(frozen=True)
class Due:
    """Driven reference, and its time 0 on the controller's clock [s], which waiting shifts."""

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
        Reason in words; empty in normal operation.
    result
        Step result of the controller; None if it was not called.
    request
        Request to the controller.
    """

    command: FloatArray
    state: LoopState
    message: str
    result: StepResult | None = None
    request: Request | None = None

    @property
    def mode(self) -> str:
        """Mode of the controller, or state of the loop without a controller step."""
        return str(self.state if self.result is None else self.result.mode)


class ControlLoop:
    """Asks the controller for a command once per tick; it adds no control.

    Parameters
    ----------
    controller
        A newly built controller.
    settings
        The node's own settings.
    inbox
        Source of the measurements; its clock is that of the controller.
    trajectory
        Reference to drive along until another one is offered; None: no reference.
    in_sim_time
        Whether the period is measured by the node's clock instead of the computer's.
    held
        Whether the loop starts held, see `hold`.

    Attributes
    ----------
    state
        State of the loop; a hold does not change it.
    held
        Whether the robot is kept from moving, whatever the state.
    objection
        Why the node does not let the robot drive; the robot then brakes as for stale odometry. Empty: it may drive.
    wait_reason
        Reason for which the robot brakes and stands for now, without a failure; the state does not change. Empty: it
        drives.
    relaid
        Number of times that the current reference was placed again because its frame had moved.
    warning
        Any other anomaly around the loop, for diagnostics.
    refusal
        Why the last reference or goal was refused, for diagnostics; empty once one is accepted.
    shortfall
        Limits that the last accepted reference exceeds, in words; empty without any.
    blocked
        Whether it paused because the robot was blocked.
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
        self._begin_when_ready = settings.drive_on_activate
        self._reference = trajectory
        self._placement: Placement | None = None
        self._laid: MovedReference | None = None
        self._lost = ""
        self.relaid = 0
        self._moves_to_robot = settings.start_at_robot
        self._next: tuple[Reference, float | None] | None = None
        self._set_aside: tuple[Reference | None, Placement | None, bool] | None = None
        self.blocked = False
        self.begun: Begun | None = None
        self.held = held
        self.objection = self.warning = self.refusal = self.wait_reason = self._end_reason = ""
        self._published: tuple[Begun, Due] | None = None
        self._requests = 0
        # A newly activated node counts as reset.
        self._was_reset = True
        self.last: LoopTick | None = None
        self.shortfall = "" if trajectory is None else str(controller.find_shortfall(trajectory) or "")

    @property
    def reference(self) -> Reference | None:
        """Reference that is driven, or that the next start drives along; None where there is none."""
        return self._reference

    @property
    def speed_limit(self) -> float | None:
        """Limit of the speed from outside [m/s]; None where there is none."""
        return self._controller.speed_limit

    def offer(self, reference: Reference, placement: Placement | None = None) -> None:
        """Use `reference` at the next start, or at once if the robot drives or `drive_on_reference` starts it.

        With `placement`, the reference is stated in a frame other than the control frame and moves with that frame.

        Raises
        ------
        ValueError
            If the reference exceeds the speed limits, or the position of its frame is not known.
        """
        if self._is_latched:
            raise RefusedError("the robot stopped after a failure: call start or resume before a new reference")
        if placement is not None:
            placement.motion()
        self._check(reference)
        # It states its frame, so it stays where it is.
        self._reference, self._placement, self._moves_to_robot, self.refusal = reference, placement, False, ""
        if self.state is LoopState.DRIVING:
            self._next = self._set_aside = None
            self._start_controller(reference, self.inbox.now)
        elif self._settings.drive_on_reference and self.state is LoopState.IDLE:
            self._begin_when_ready = True

    def follow(self, reference: Reference, t0: float | None = None) -> None:
        """Drive along `reference` from the next tick with a pose on, in any state, until `release`.

        Parameters
        ----------
        reference
            The reference; it is not moved to the robot.
        t0
            Time of the controller's clock at the reference's time 0 [s]; None: the tick at which it begins.

        Raises
        ------
        ValueError
            If measurements are missing, or it is faster than the limits.
        """
        missing = self.missing()
        if missing:
            raise RefusedError(missing)
        self._check(reference)
        self._next, self.refusal = (reference, t0), ""

    def brake(self, reason: str) -> None:
        """Brake and stand, in any state of the loop; a pending start is cancelled."""
        self._next, self._begin_when_ready = None, False
        if self.state in (LoopState.DRIVING, LoopState.PAUSED):
            self.state, self._reason = LoopState.PAUSED, reason

    def end(self, reason: str) -> None:
        """Brake and stand for good: nothing that is requested afterwards moves the robot."""
        self._end_reason = reason

    @property
    def is_moving(self) -> bool:
        """True if the last command was not zero."""
        return self.last is not None and bool(self.last.command.any())

    def release(self) -> None:
        """Return to idle after `follow` and restore the previous reference; a fault remains a fault."""
        self._next, self._begin_when_ready, self.blocked, self.wait_reason, self.shortfall = None, False, False, "", ""
        if self._set_aside is not None:
            (self._reference, self._placement, self._moves_to_robot), self._set_aside = self._set_aside, None
        if self.state is not LoopState.FAULT:
            self.state, self._reason = LoopState.IDLE, ""

    def whereabouts(self) -> tuple[FloatArray, tuple[float, float]] | None:
        """Return pose (3,) and twist [m/s, rad/s] of the robot; return None if they are unknown."""
        if self.missing():
            return None
        result = None if self.last is None else self.last.result
        if result is not None and result.estimate is not None:
            return result.estimate.pose.copy(), (float(result.estimate.twist[0]), float(result.estimate.twist[1]))
        pose = self.inbox.newest_pose
        return None if pose is None else (np.array(pose.value, dtype=float), (0.0, 0.0))

    def start(self) -> str:
        """Start to drive with the next tick, or resume after a pause; return the action in words.

        Raises
        ------
        ValueError
            If the robot drives already, measurements are missing, or there is no reference within the limits.
        """
        if self.state is LoopState.PAUSED:
            return self.resume()
        standing = self.last is not None and self.last.mode in (Mode.FINISHED, Mode.STOPPED)
        if self.state is LoopState.DRIVING and not standing:
            raise RefusedError("it is driving already; pause it first")
        self._refuse_if_missing()
        assert self._reference is not None
        self._check(self._reference)
        if self.state is LoopState.FAULT:
            self._reset_controller()
        self.state, self._reason, self._begin_when_ready = LoopState.IDLE, "", True
        begins = f"begins '{self._reference.name}', {self._reference.duration:.1f} s{self._once_let_go()}"
        return "; ".join(filter(None, [begins, self.shortfall]))

    def resume(self) -> str:
        """Resume the reference where it waits, after a pause or a failure; returns what it does.

        Raises
        ------
        ValueError
            If nothing waits for it, or measurements are missing.
        """
        if self.state is not LoopState.PAUSED and not self._is_latched:
            raise RefusedError(f"nothing waits for it ({self.state}); call start to begin")
        self._refuse_if_missing()
        self._controller.resume()
        self.state, self._reason, self.blocked = LoopState.DRIVING, "", False
        return f"drives on{self._once_let_go()}"

    @property
    def _is_latched(self) -> bool:
        """True while a drive that stopped after a failure waits for a person."""
        return self.state is LoopState.DRIVING and self._controller.is_latched

    def pause(self, reason: str = "paused; call start to drive on") -> str:
        """Brake and stand; the reference waits. Returns what it does; raises RefusedError if it stands idle."""
        if self._begin_when_ready or (self._next is not None and self.state is not LoopState.DRIVING):
            self._begin_when_ready, self._next = False, None
            return "does not begin any more"
        if self.state is not LoopState.DRIVING:
            raise RefusedError(f"it does not drive ({self.state})")
        self.state, self._reason, self._next = LoopState.PAUSED, reason, None
        return "brakes"

    def hold(self, *, on: bool) -> str:
        """Brake and stand while `on`, whatever else is requested; the state does not change. Returns a message."""
        before, self.held = self.held, on
        if on:
            return "is held already" if before else "is held; brakes" if self.is_moving else "is held"
        if not before:
            return "was not held"
        if self._is_latched:
            return "let go; stands after a failure; call start or resume to drive"
        if self.state is LoopState.DRIVING:
            return "let go; drives on"
        waits = " begins when it can" if self._begin_when_ready else " stands; call start to drive"
        return f"let go;{waits} ({self.state})"

    def reset(self) -> str:
        """Reset estimate, measurements and progress; return the action in words; raise RefusedError while moving."""
        if self.is_moving:
            raise RefusedError("the robot is still driving; pause first")
        self._reset_controller()
        self.inbox.restart()
        self.state, self._reason, self._begin_when_ready, self.begun = LoopState.IDLE, "", False, None
        self._next, self.blocked = None, False
        return "is as new; call start to begin"

    def tick(self) -> LoopTick:
        """Decide the next command. Never raises: an exception ends in zero and FAULT."""
        started = time.perf_counter()
        self.times.start_tick(self._steady())
        try:
            tick = self._decide(self.inbox.now)
        except Exception as error:  # the robot has to stop in any case
            self.state, self._reason = LoopState.FAULT, f"{type(error).__name__}: {error}; call start to begin anew"
            tick = self._standing()
        self.last = tick
        age = self.inbox.odometry.age(self.inbox.now)
        self.times.end(time.perf_counter() - started, age if np.isfinite(age) else None)
        return tick

    def due(self) -> Due | None:
        """Return the reference and its start time to publish; return None if the last ones still hold.

        This is needed at the start of a drive, after a wait of the reference, and after a shift of its frame.
        """
        begun, last = self.begun, self.last
        if begun is None or last is None:
            return None
        if self._published is None or self._published[0] is not begun:
            self._published = begun, Due(begun.reference, begun.t0)
            return self._published[1]
        published, reference = self._published[1], self._laid or begun.reference
        t0 = begun.t0 + self._controller.planned_delay
        drives = last.mode in (Mode.TRACKING, Mode.REUSED_PLAN)
        if not drives or (abs(t0 - published.t0) < _TELL_DELAY and not self._is_moved(published.reference, reference)):
            return None
        self._published = begun, Due(reference, t0)
        return self._published[1]

    def _is_moved(self, published: Reference, reference: Reference) -> bool:
        """Return True if the frame of the reference has moved enough to publish the reference again."""
        pose = self.inbox.newest_pose
        if pose is None or not (isinstance(published, MovedReference) and isinstance(reference, MovedReference)):
            return False
        return _apart(published.motion, reference.motion, pose.value) > _TELL_MOTION

    def _decide(self, t: float) -> LoopTick:
        self.inbox.look_up_pose()
        if self._begin_when_ready and self._reference is not None and not self._missing():
            self._begin_when_ready = False
            self._start_controller(self._reference, t)
            self.state = LoopState.DRIVING
        if self._next is not None and self.inbox.has_pose and not self.missing():
            self._begin_next(t)
        if self.state in (LoopState.IDLE, LoopState.FAULT):
            return self._standing()
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
        """Return the end of this tick's time for a solve by `time.monotonic` [s]; a simulated robot waits for it."""
        if self._in_sim_time:
            return None
        config = self._controller.config
        return time.monotonic() + (config.solver.time_limit or _SHARE_OF_TICK * config.sample_time)

    def _begin_next(self, t: float) -> None:
        assert self._next is not None
        (reference, t0), self._next = self._next, None
        if self.state is LoopState.FAULT:
            self._reset_controller()
        if self._set_aside is None:
            self._set_aside = (self._reference, self._placement, self._moves_to_robot)
        self._reference, self._placement, self._moves_to_robot = reference, None, False
        self._start_controller(reference, t if t0 is None else t0)
        self.state, self._reason, self.blocked, self._begin_when_ready = LoopState.DRIVING, "", False, False

    def _hold(self, t: float) -> Hold | None:
        if self._end_reason:
            return Hold(self._end_reason)
        if self.state is LoopState.PAUSED:
            return Hold(self._reason)
        silence = self.inbox.odometry.fault(t, self._settings.odom_timeout)
        within = self._controller.config.failure.resume_within
        if silence and not -within <= self.inbox.odometry.age(t) <= within:
            return Hold(silence, failure=True, waits=True)
        if self.held:
            return Hold(HELD)
        if self.wait_reason:
            return Hold(self.wait_reason)
        fault = self.objection or silence or self._lost
        return Hold(fault, failure=True) if fault else None

    def _follow_frame(self) -> None:
        """Move the reference with its frame; if the frame's position is not known, the robot has to stand."""
        self._lost = ""
        if self._placement is None or self._laid is None:
            return
        try:
            motion = self._placement.motion()
        except ValueError as error:
            self._lost = str(error)
            return
        pose = self.inbox.newest_pose
        if pose is None or _apart(self._laid.motion, motion, pose.value) <= _STAYS:
            return
        self._laid = MovedReference(self._laid.original, motion)
        self._controller.switch_reference(self._laid)
        self.relaid += 1

    def _once_let_go(self) -> str:
        return ", once it is let go (hold)" if self.held else ""

    def _standing(self) -> LoopTick:
        waiting = self._missing() if self._begin_when_ready else ""
        return LoopTick(np.zeros(2), self.state, "; ".join(filter(None, [self._reason or waiting, HELD * self.held])))

    def _missing(self) -> str:
        """Describe what is missing to start, in words; return an empty string if nothing is."""
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
        """Describe the missing measurement or the objection to driving; return an empty string without any."""
        inbox = self.inbox
        fault = self.objection or inbox.odometry.fault(inbox.now, self._settings.odom_timeout)
        if not fault and self._settings.poses_from != "odometry":
            fault = inbox.pose.fault(inbox.now, self._controller.config.failure.max_pose_age)
        return fault

    def _refuse_if_missing(self) -> None:
        missing = self._missing()
        if missing:
            raise RefusedError(missing)

    def _check(self, reference: Reference) -> None:
        config = self._controller.config
        check_speeds(reference, config.limits, config.sample_time, self._controller.model.dc_gain)
        self.shortfall = str(self._controller.find_shortfall(reference, is_moving=self.is_moving) or "")

    def _start_controller(self, reference: Reference, t0: float) -> None:
        pose = self.inbox.newest_pose
        self._laid = None
        if self._placement is not None:
            reference = self._laid = MovedReference(reference, self._placement.motion())
        elif self._moves_to_robot and pose is not None:
            reference = starting_at(reference, pose.value)
        # A planner sends a new path each second, and learned slip outlasts it.
        goes_on = self.state is LoopState.DRIVING and self.last is not None and self.last.mode is Mode.TRACKING
        if goes_on:
            self._controller.switch_reference(reference, t0)
        else:
            self._controller.start(reference, t0)
        self.begun = Begun(reference, t0, self._was_reset, goes_on)

    def _reset_controller(self) -> None:
        self._controller.reset()
        self._was_reset = True


def _apart(before: FloatArray, after: FloatArray, pose: ArrayLike) -> float:
    """Compute displacement [m] plus rotation [rad] at `pose` (3,) when `after` replaces the motion `before`."""
    (ax, ay, a), (bx, by, b) = before, after
    start = np.asarray(pose, dtype=float)
    x, y = start[0] - ax, start[1] - ay
    # Undo the motion `before`, then apply the motion `after`.
    x, y = math.cos(a) * x + math.sin(a) * y, -math.sin(a) * x + math.cos(a) * y
    end = bx + math.cos(b) * x - math.sin(b) * y, by + math.sin(b) * x + math.cos(b) * y
    return math.hypot(end[0] - start[0], end[1] - start[1]) + abs(math.remainder(b - a, math.tau))
