"""Iterative learning: the errors of the laps before become a correction of the reference for the next lap.

Of what goes wrong on a path, part is the same on every lap: what the model gets wrong in a start, a stop or a curve.
Feedback finds it when it has happened; on a path driven again it is known beforehand. The controller then tracks
the reference moved by a correction c, along and across itself, over its own time. The closed loop follows such a motion,
as it looks ahead, so a lap's errors are e = d + c with d what repeats, and after the lap k

    c <- Q ((1 - forgetting) c - max(gain, 1 / k) e)

Q is a smoothing without phase, which keeps out what the loop is too slow for. The 1 / k makes c the mean of all laps
at first, so that what does not repeat averages out. Source of the law: Bristow, Tharayil, Alleyne, IEEE Control
Systems Magazine 26(3), 2006 (P-type with Q-filter and forgetting).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory

# Slower than this a robot cannot be moved across its path by its heading [m/s], as in `mpc.problem.formulas.aim`.
_SLOW = 0.1
_ON_ITS_WAY = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.FINISHED)


@dataclass
class _Lap:
    """What was recorded since a start: rows of time [s] on the reference's clock and numbers."""

    motion: list[FloatArray] = field(default_factory=list)
    """time, x, y [m], theta [rad], v [m/s], omega [rad/s] as estimated, and both gains of slip"""
    poses: list[FloatArray] = field(default_factory=list)
    """time, x, y [m], theta [rad] as measured, at their stamps"""
    spoilt: str = ""


class Rehearsal:
    """Records laps, and gives each start of a reference the reference to track.

    Parameters
    ----------
    config
        Its group `rehearsal`, and the sample time.

    Attributes
    ----------
    laps
        From how many laps the correction was learned.
    time
        (n,) times of the reference [s] at which the correction is kept.
    correction
        (n, 3) by how much the tracked reference lies along and across the given one [m], and is turned against it [rad].
    said
        What was learned or forgotten at the last start, in words.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self._settings, self._dt = config.rehearsal, config.sample_time
        self.forget()

    def forget(self) -> None:
        """Be as new."""
        self._reference: Reference | None = None
        self._lap, self._t0 = _Lap(), 0.0
        self.time: FloatArray = np.empty(0)
        self._begin_anew("")

    def _begin_anew(self, why: str) -> None:
        self.laps, self.said = 0, why
        self.correction: FloatArray = np.zeros((len(self.time), 3))
        self._gains: FloatArray = np.ones(2)
        self._first_error = np.inf

    def begin(self, reference: Reference, t0: float) -> Reference:
        """Learn from the lap that was driven, and begin the next, whose time 0 is `t0` [s].

        Returns
        -------
        Reference
            What to track: `reference` moved by the correction, or itself where nothing is learned of it. The same path
            and times elsewhere are the same reference.
        """
        if self._reference is not None and _same(self._reference, reference, self.time):
            self._learn(self._reference)
        else:
            count = int(np.ceil(reference.duration / self._dt)) + 1
            self.time = np.linspace(0.0, reference.duration, count)
            self._begin_anew("")
        self._reference, self._lap, self._t0 = reference, _Lap(), t0
        return corrected(reference, self.time, self.correction) if self.correction.any() else reference

    def take(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick at `t` [s]; returns `result`, at the first tick with what was learned in its message."""
        lap, now = self._lap, t - self._t0
        first = not lap.motion
        if now <= self.time[-1] + self._dt and not lap.spoilt:
            estimate = result.estimate
            if estimate is None or result.mode not in _ON_ITS_WAY or result.reference_delay != 0.0:
                lap.spoilt = f"at {now:.2f} s it was {result.mode}, {result.reference_delay:.2f} s late"
            else:
                lap.motion.append(np.concatenate([[now], estimate.pose, estimate.twist, estimate.slip.gains]))
            if measurement.pose is not None:
                pose = np.asarray(measurement.pose.value, dtype=float)
                lap.poses.append(np.concatenate([[measurement.pose.time - self._t0], pose]))
        if first and self.said:
            words = f"rehearsal: {self.said}"
            return replace(result, message=f"{result.message}; {words}" if result.message else words)
        return result

    def _learn(self, reference: Reference) -> None:
        """One step of the law above, or back to nothing where it does harm or the floor is another one."""
        settings, lap = self._settings, self._lap
        motion, poses = np.array(lap.motion), np.array(lap.poses)
        if lap.spoilt or not len(poses) or motion[-1, 0] < self.time[-1] - 2 * self._dt:
            self.said = f"not learned from the last lap: {lap.spoilt or 'it was not driven to its end'}"
            return
        error = self._error(reference, motion, poses)
        gains, size = motion[:, 6:].mean(axis=0), float(np.sqrt(np.mean(error[:, :2] ** 2) * 2))
        change = float(np.abs(gains / self._gains - 1).max())
        if self.laps and change > settings.floor_change:
            return self._begin_anew(f"forgotten, as gains of slip changed by {100 * change:.0f} %: another floor")
        if self.laps and size > settings.worse * self._first_error:
            return self._begin_anew(f"forgotten, as the error was {1e3 * size:.1f} mm, {1e3 * self._first_error:.1f} without")
        if not self.laps:
            self._first_error = size
        self.laps += 1
        share = max(settings.gain, 1 / self.laps)
        self._gains = gains if self.laps == 1 else self._gains + share * (gains - self._gains)
        self.correction = self._bounded((1 - settings.forgetting) * self.correction - share * error, reference)
        largest = 1e3 * float(np.hypot(*self.correction.T[:2]).max())
        self.said = f"{self.laps} laps learned from, error {1e3 * size:.1f} mm in the last, correction up to {largest:.1f} mm"

    def _error(self, reference: Reference, motion: FloatArray, poses: FloatArray) -> FloatArray:
        """(n, 3) error of the lap along and across the reference and in heading, from the measured poses.

        The estimated twist, added up, has the shape of the motion but drifts; its distance from the poses, smoothed, is
        the drift.
        """
        expected = reference.sample(self.time).pose
        v, omega = (np.interp(self.time, motion[:, 0], motion[:, 4 + i]) for i in (0, 1))
        poses = poses[(poses[:, 0] >= 0) & (poses[:, 0] <= self.time[-1])]
        at, seen = poses[:, 0], poses[:, 1:]
        near = np.interp(at, self.time, expected[:, 2])
        theta = self._undrifted(_summed(omega, self.time), at, near + wrap_angle(seen[:, 2] - near))
        error = np.empty_like(expected)
        for i, direction in enumerate((np.cos(theta), np.sin(theta))):
            error[:, i] = self._undrifted(_summed(v * direction, self.time), at, seen[:, i]) - expected[:, i]
        error[:, 2] = wrap_angle(theta - expected[:, 2])
        return _turned(error, -expected[:, 2])

    def _undrifted(self, shape: FloatArray, at: FloatArray, seen: FloatArray) -> FloatArray:
        """`shape` (n,) moved onto what was `seen` (m,) at the times `at` (m,), smoothed."""
        step = self.time[1] - self.time[0]
        place = np.clip(np.rint(at / step).astype(int), 0, len(shape) - 1)
        distance, count = np.zeros_like(shape), np.zeros_like(shape)
        np.add.at(distance, place, seen - np.interp(at, self.time, shape))
        np.add.at(count, place, 1.0)
        width = self._settings.smoothing / step
        near = gaussian_filter1d(count, width, mode="constant", truncate=8.0)
        return shape + gaussian_filter1d(distance, width, mode="constant", truncate=8.0) / np.maximum(near, 1e-12)

    def _bounded(self, correction: FloatArray, reference: Reference) -> FloatArray:
        """The correction (n, 3) smoothed, inside its bounds, from nothing at the start, its heading along its path."""
        settings = self._settings
        step = self.time[1] - self.time[0]
        moved = gaussian_filter1d(correction[:, :2], settings.smoothing / 2 / step, axis=0, mode="nearest")
        moved *= np.minimum(1.0, self.time / settings.smoothing)[:, None]
        moved *= np.minimum(1.0, settings.largest / np.maximum(np.hypot(*moved.T), 1e-12))[:, None]
        rate = np.gradient(moved, step, axis=0)
        moved *= min(1.0, settings.largest_speed / max(float(np.hypot(*rate.T).max()), 1e-12))
        v = reference.sample(self.time).twist[:, 0]
        turned = np.gradient(moved[:, 1], step) * v / (v**2 + _SLOW**2)
        return np.column_stack([moved, np.clip(turned, -settings.largest_heading, settings.largest_heading)])


def corrected(reference: Reference, time: FloatArray, correction: FloatArray) -> SplineTrajectory:
    """`reference` moved by `correction` (n, 3) along and across itself [m] and turned [rad] at the times (n,) [s]."""
    given = reference.sample(time)
    heading = given.pose[:, 2]
    change = _turned(correction, heading)
    v, omega = given.twist.T
    rate = np.column_stack([v * np.cos(heading), v * np.sin(heading), omega])
    rate += np.gradient(change, time[1] - time[0], axis=0)
    return SplineTrajectory.through(reference.name, time, given.pose + change, rate)


def _same(one: Reference, other: Reference, time: FloatArray) -> bool:
    """Whether both are the same motion, be it in another place."""
    return abs(one.duration - other.duration) < 1e-6 and np.allclose(  # noqa: PLR2004
        one.sample(time).twist, other.sample(time).twist, rtol=0.0, atol=1e-6
    )


def _summed(rate: FloatArray, time: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])


def _turned(rows: FloatArray, angle: FloatArray) -> FloatArray:
    """Rows (n, 3) of x, y, theta turned by an angle (n,) each; theta stays."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.column_stack([cos * rows[:, 0] - sin * rows[:, 1], sin * rows[:, 0] + cos * rows[:, 1], rows[:, 2]])
