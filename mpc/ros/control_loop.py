"""The control loop: what one tick of the node does, and how driving is begun, paused and reset. Needs no ROS itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.latency import LoopTimes
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories.moved import starting_at
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds


class LoopState(StrEnum):
    """What an active node does."""

    IDLE = "IDLE"
    """Commands zero and waits for `start`."""
    DRIVING = "DRIVING"
    """The controller decides."""
    PAUSED = "PAUSED"
    """The controller brakes and stands; `start` drives on."""
    FAULT = "FAULT"
    """Commands zero after an exception; `start` begins anew."""


class RefusedError(DiffdriveMpcError, ValueError):
    """A request that cannot be granted now; says why and what to do."""


@dataclass(frozen=True)
class Asked:
    """What the controller was given at `time` [s], and how often it was asked by then."""

    number: int
    time: float
    measurement: Measurement
    hold: Hold | None


@dataclass(frozen=True)
class Begun:
    """A start of the controller: the reference as it was placed, its time 0 [s], and whether a reset came before."""

    reference: Reference
    t0: float
    reset: bool


@dataclass(frozen=True)
class Tick:
    """What one tick did.

    Attributes
    ----------
    command
        (2,) v [m/s], omega [rad/s] to be sent.
    state
        What the loop does.
    message
        Why, in words; empty when all is well.
    result
        The controller's, where it was asked.
    asked
        What it was asked.
    """

    command: FloatArray
    state: LoopState
    message: str
    result: StepResult | None = None
    asked: Asked | None = None

    @property
    def mode(self) -> str:
        """Mode of the controller, or what the loop does instead."""
        return str(self.state if self.result is None else self.result.mode)


class ControlLoop:
    """Asks the controller for a command once a tick; adds no control of its own.

    Parameters
    ----------
    controller
        The controller, as new.
    settings
        The node's own settings.
    inbox
        Where measurements come from; its clock is that of the controller.
    trajectory
        What to drive along until another reference is offered; None: nothing.
    in_sim_time
        Whether the period is to be judged by the node's clock instead of the computer's.
    """

    def __init__(
        self,
        controller: Controller,
        settings: NodeSettings,
        inbox: Inbox,
        trajectory: Reference | None,
        *,
        in_sim_time: bool,
    ) -> None:
        self._controller, self._settings, self.inbox = controller, settings, inbox
        self._steady: Callable[[], float] = (lambda: self.inbox.now) if in_sim_time else time.perf_counter
        self.times = LoopTimes(controller.config.sample_time, settings.statistics_window)
        self.state = LoopState.IDLE
        self.fallbacks = 0
        self._reason = ""
        self._begin_when_ready = settings.drive_on_activate
        self._reference = trajectory
        self._moves_to_robot = settings.start_at_robot
        self.begun: Begun | None = None
        self._asked = 0
        # So it is when the node is activated.
        self._was_reset = True
        self.last: Tick | None = None

    def offer(self, reference: Reference) -> None:
        """Take `reference` for the next start, or at once where the robot drives or shall drive as one arrives.

        Raises
        ------
        ValueError
            If it is faster than the limits.
        """
        self._check_speeds(reference)
        # It states its frame, so it stays where it is.
        self._reference, self._moves_to_robot = reference, False
        if self.state is LoopState.DRIVING:
            self._start_controller(reference)
        elif self._settings.drive_on_reference and self.state is LoopState.IDLE:
            self._begin_when_ready = True

    def start(self) -> str:
        """Begin to drive with the next tick, or drive on after a pause; returns what it does.

        Raises
        ------
        ValueError
            If the robot drives already, measurements are missing, or there is no reference within the limits.
        """
        if self.state is LoopState.PAUSED:
            self._refuse_if_missing()
            self.state, self._reason = LoopState.DRIVING, ""
            return "drives on"
        standing = self.last is not None and self.last.mode in (Mode.FINISHED, Mode.STOPPED)
        if self.state is LoopState.DRIVING and not standing:
            raise RefusedError("it is driving already; pause it first")
        self._refuse_if_missing()
        assert self._reference is not None
        self._check_speeds(self._reference)
        if self.state is LoopState.FAULT:
            self._reset_controller()
        self.state, self._reason, self._begin_when_ready = LoopState.IDLE, "", True
        return f"begins '{self._reference.name}', {self._reference.duration:.1f} s"

    def pause(self, reason: str = "paused; call start to drive on") -> str:
        """Brake and stand; the reference waits. Returns what it does; raises RefusedError if it stands idle."""
        if self._begin_when_ready:
            self._begin_when_ready = False
            return "does not begin any more"
        if self.state is not LoopState.DRIVING:
            raise RefusedError(f"it does not drive ({self.state})")
        self.state, self._reason = LoopState.PAUSED, reason
        return "brakes"

    def reset(self) -> str:
        """Forget estimate, measurements and progress; returns what it does; raises RefusedError while it moves."""
        if self.last is not None and self.last.command.any():
            raise RefusedError("the robot is still driving; pause first")
        self._reset_controller()
        self.inbox.restart()
        self.state, self._reason, self._begin_when_ready, self.begun = LoopState.IDLE, "", False, None
        return "is as new; call start to begin"

    def tick(self) -> Tick:
        """Decide the next command. Never raises: an exception ends in zero and FAULT."""
        started = time.perf_counter()
        self.times.begin(self._steady())
        try:
            tick = self._decide(self.inbox.now)
        except Exception as error:  # whatever happens, the robot has to stop
            self.state, self._reason = LoopState.FAULT, f"{type(error).__name__}: {error}; call start to begin anew"
            tick = self._standing()
        self.last = tick
        age = self.inbox.odometry.age(self.inbox.now)
        self.times.end(time.perf_counter() - started, age if np.isfinite(age) else None)
        return tick

    def _decide(self, t: float) -> Tick:
        if self._begin_when_ready and self._reference is not None and not self._missing():
            self._begin_when_ready = False
            self._start_controller(self._reference)
            self.state = LoopState.DRIVING
        if self.state in (LoopState.IDLE, LoopState.FAULT):
            return self._standing()
        self._asked += 1
        asked = Asked(self._asked, t, self.inbox.measurement(), self._hold(t))
        result = self._controller.step(t, asked.measurement, asked.hold)
        self._was_reset = False
        self.fallbacks += result.mode in (Mode.REUSED_PLAN, Mode.BRAKING)
        if self.state is LoopState.DRIVING and result.blocked_for >= self._settings.blocked_timeout:
            self.pause(f"blocked for {result.blocked_for:.1f} s; clear the way and call start")
        return Tick(result.command, self.state, result.message, result, asked)

    def _hold(self, t: float) -> Hold | None:
        if self.state is LoopState.PAUSED:
            return Hold(self._reason)
        fault = self.inbox.odometry.fault(t, self._settings.odom_timeout)
        return Hold(fault, failure=True) if fault else None

    def _standing(self) -> Tick:
        waiting = self._missing() if self._begin_when_ready else ""
        return Tick(np.zeros(2), self.state, self._reason or waiting)

    def _missing(self) -> str:
        """What is missing to begin, in words; empty if nothing is."""
        inbox = self.inbox
        fault = inbox.odometry.fault(inbox.now, self._settings.odom_timeout)
        if not fault and self._settings.use_pose_topic:
            fault = inbox.pose.fault(inbox.now, self._controller.config.failure.max_pose_age)
        if not fault and self._reference is None:
            fault = "there is no reference: set the parameter trajectory, or publish one"
        return fault

    def _refuse_if_missing(self) -> None:
        missing = self._missing()
        if missing:
            raise RefusedError(missing)

    def _check_speeds(self, reference: Reference) -> None:
        config = self._controller.config
        check_speeds(reference, config.limits, config.sample_time, self._controller.model.dc_gain)

    def _start_controller(self, reference: Reference) -> None:
        pose = self.inbox.newest_pose
        if self._moves_to_robot and pose is not None:
            reference = starting_at(reference, pose.value)
        t0 = self.inbox.now
        self._controller.start(reference, t0)
        self.begun = Begun(reference, t0, self._was_reset)

    def _reset_controller(self) -> None:
        self._controller.reset()
        self._was_reset = True
