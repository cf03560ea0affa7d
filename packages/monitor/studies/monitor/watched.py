"""A controller with the monitor behind it, in the closed loop of the simulation."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from studies.monitor.faults import Fault, Sent

from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.models.logs.drive_log.topics import path_times
from diffdrive_mpc_monitor.judge import Judge, MonitorVerdict
from diffdrive_mpc_monitor.rules import Rules

BASE_TIMEOUT = 0.5
"""The base stops by itself so long after the last command [s], as `sim/ros/base.yaml` has it."""
_STANDING = frozenset({"STOPPED", "FINISHED", "PAUSED", "IDLE"})
"""Modes in which a controller says that it does not drive."""
_TOLD_AGAIN = 0.2
"""The node sends its reference anew where that is due so much later or earlier [s]."""
_BEFORE = 1000.0
"""The clock at time 0 [s]: a stamp of 0 means "none", as in ROS."""


class WatchedStep(NamedTuple):
    """What came out of a tick, as `models.interface.ControlStep` has it: the command is that of the monitor."""

    command: FloatArray
    mode: str
    message: str
    step_time: float
    solve_time: float = math.nan
    solver: None = None
    plan: FloatArray | None = None


class MonitoredController:
    """Drives with `inner`, whose commands go through the monitor; satisfies `models.interface.TrackingController`.

    Parameters
    ----------
    inner
        Who decides.
    rules
        Of the monitor.
    fault
        What breaks it; None: nothing.
    """

    def __init__(self, inner: TrackingController, rules: Rules, fault: Fault | None = None) -> None:
        self._inner, self._rules, self._fault = inner, rules, fault or Fault()

    stood: list[bool]
    """Of each tick, whether the controller sent nothing but zero and said that it stands."""

    @property
    def verdict(self) -> MonitorVerdict:
        """What stopped the robot, on the clock of the plant; nothing while all is well."""
        verdict = self._judge.verdict
        return verdict._replace(at=verdict.at - _BEFORE) if verdict else verdict

    def start(self, reference: Reference, t0: float) -> None:
        """Begin to track; the monitor is told of the reference as by the node."""
        self._fault.start(reference)
        self._inner.start(self._fault.followed(reference), t0)
        self._judge = Judge(self._rules, t0 + _BEFORE)
        self._reference, self._t0 = reference, t0
        self._tell_reference(t0, 0.0)
        self._summed, self._summed_at = reference.sample([0.0]).pose[0].tolist(), t0
        self._base, self._base_at = (0.0, 0.0), t0
        self.stood: list[bool] = []

    def step(self, t: float, measurement: Measurement) -> WatchedStep:
        """Decide, judge, and pass on."""
        fault, now = self._fault, t + _BEFORE
        broken = fault.active(t)
        measurement = fault.measures(measurement) if broken else measurement
        self._tell(t, measurement)
        step: ControlStep = self._inner.step(t, fault.sees(measurement) if broken else measurement)
        command, mode = Sent(t, float(step.command[0]), float(step.command[1])), str(step.mode)
        sent = fault.sends(command) if broken else [command]
        fault.went(sent)
        planned = getattr(self._inner, "planned_delay", 0.0)
        if mode not in _STANDING and abs(planned - self._planned) >= _TOLD_AGAIN:
            self._tell_reference(t, planned)
        self.stood.append(mode in _STANDING and not any(any(one[1:]) for one in sent))
        self._judge.says(now, drives=(fault.says(mode) if broken else mode) not in _STANDING)
        for one in sent:
            self._base, self._base_at = self._judge.command(now, one.stamp + _BEFORE, one.v, one.omega), t
        stopped = self._judge.tick(now)
        if stopped is not None:
            self._base, self._base_at = stopped, t
        if t - self._base_at > BASE_TIMEOUT:
            self._base = (0.0, 0.0)
        driven = fault.obeys(self._base) if broken else self._base
        return WatchedStep(np.array(driven), mode, step.message, step.step_time)

    def _tell_reference(self, t: float, delay: float) -> None:
        """Tell the judge of the reference, which is due so late [s]."""
        times = path_times(self._reference.duration)
        points = np.column_stack([times + self._t0 + delay + _BEFORE, self._reference.sample(times).pose])
        self._judge.reference(t + _BEFORE, self._fault.told(points).tolist())
        self._planned = delay

    def _tell(self, t: float, measurement: Measurement) -> None:
        """What base and sensors say, as on their topics."""
        now, judge = t + _BEFORE, self._judge
        if measurement.yaw_rate is not None:
            judge.gyro(now, measurement.yaw_rate.time + _BEFORE, float(np.asarray(measurement.yaw_rate.value)))
        if measurement.wheel_twist is not None:
            twist = np.asarray(measurement.wheel_twist.value).tolist()
            self._sum_up(measurement.wheel_twist.time, *twist)
            judge.odometry(now, measurement.wheel_twist.time + _BEFORE, twist, self._summed)
        if measurement.pose is not None:
            judge.pose(now, measurement.pose.time + _BEFORE, np.asarray(measurement.pose.value).tolist())

    def _sum_up(self, time: float, v: float, omega: float) -> None:
        """Carry on the pose of the odometry."""
        step, self._summed_at = time - self._summed_at, time
        x, y, theta = self._summed
        middle = theta + 0.5 * step * omega
        self._summed = [x + step * v * math.cos(middle), y + step * v * math.sin(middle), theta + step * omega]
