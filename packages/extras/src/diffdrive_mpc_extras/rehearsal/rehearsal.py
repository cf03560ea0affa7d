"""Iterative learning: the errors of the laps before become a correction of the reference for the next lap.

A part of the errors on a path is the same on every lap: errors of the model in a start, a stop or a curve. Feedback
finds it when it has happened; on a path driven again it is known beforehand. The controller then tracks the reference
moved by a correction c, along and across itself, over its own time. Because of its prediction, the robot follows slow
motions of its reference, so a lap's errors are e = d + c with d the repeating part. After the lap k

    d <- (1 - forgetting) (d + max(gain, 1 / k) (e - c - d)),    c = -Q trust d

The 1 / k makes d the mean of all laps at first. `trust` is the reliable part of d, as in a Wiener filter:
1 - variance of d / local power of d. Q smooths without phase, as the robot does not follow fast changes. The law is
iterative learning control with a Q-filter: Bristow, Tharayil, Alleyne, IEEE Control Systems Magazine 26(3), 2006.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.tick import numbers
from diffdrive_mpc.mpc.problem.formulas import SLOW
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of

# Weight of a single lap: the variation from lap to lap is not known yet.
_FIRST_TRUST = 0.5
# Averaging times of power and variance, in multiples of the smoothing time.
_POWER, _VARIANCE = 6, 20
# References count as the same below this distance, compared at times with this spacing [s].
_SAME, _INSTANT = 1e-6, 0.02
LONGEST = 3600.0
"""Maximum duration of a reference for learning [s]: memory and time of a start grow with it."""
_ON_ITS_WAY = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.FINISHED)


@dataclass
class _Lap:
    """Record since a start."""

    motion: list[FloatArray] = field(default_factory=list)
    """(8,) time [s], pose x, y [m], theta [rad], twist [m/s, rad/s] as estimated, both gains of slip"""
    poses: list[FloatArray] = field(default_factory=list)
    """(4,) time of its stamp [s], pose as measured"""
    spoilt: str = ""
    """Reason for which nothing can be learned from it."""


class LapLearner:
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
        (n, 3) by how much the tracked reference lies along and across the given one [m], and is turned against it
        [rad].
    said
        Learned and forgotten corrections of the last start, in words.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self._settings, self._dt = rehearsal_of(config), config.sample_time
        self._most_jump = config.estimator.max_position_jump
        self.forget()

    def forget(self) -> None:
        """Reset to the initial state."""
        self._reference: Reference | None = None
        self._lap, self._t0, self._told = _Lap(), 0.0, False
        self.time: FloatArray = np.empty(0)
        self._begin_anew("")

    def _begin_anew(self, why: str) -> None:
        count = len(self.time)
        self.laps, self.message = 0, why
        self.correction: FloatArray = np.zeros((count, 3))
        # The repeating part, its variance from lap to lap, and the part of that variance that remains in the mean.
        self._repeating, self._spread, self._left = np.zeros((count, 2)), np.zeros((count, 2)), 0.0
        self._gains: FloatArray = np.ones(2)
        self._first_error = np.inf

    def start(self, reference: Reference, t0: float) -> Reference:
        """Learn from the lap that was driven, and begin the next, whose time 0 is `t0` [s].

        Returns
        -------
        Reference
            What to track: `reference` moved by the correction, or itself where nothing is learned of it. The same path
            and times elsewhere are the same reference.
        """
        if self._reference is not None and same_motion(self._reference, reference):
            self._learn(reference)
        elif not self._dt <= reference.duration <= LONGEST:
            self.time = np.empty(0)
            self._begin_anew(f"nothing is learned of a reference that takes under a tick or over {LONGEST:g} s")
        else:
            count = max(int(np.ceil(reference.duration / self._dt)), 1) + 1
            self.time = np.linspace(0.0, reference.duration, count)
            self._begin_anew("")
        self._reference, self._lap, self._t0, self._told = reference, _Lap(), t0, False
        return corrected(reference, self.time, self.correction) if self.correction.any() else reference

    def take(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick at `t` [s]; returns `result`, with the corrections in the first message."""
        lap, now = self._lap, t - self._t0
        words = f"rehearsal: {self.message}" if self.message and not self._told else ""
        self._told = True
        # After a reset nothing is recorded until the next start.
        if self.time.size and now <= self.time[-1] + self._dt and not lap.spoilt:
            estimate = result.estimate
            if estimate is None or result.mode not in _ON_ITS_WAY or result.reference_delay != 0.0:
                lap.spoilt = f"at {now:.2f} s it was {result.mode}, {result.reference_delay:.2f} s late"
            else:
                lap.motion.append(np.concatenate([[now], estimate.pose, estimate.twist, estimate.slip.gains]))
                pose = measurement.pose
                stamp, value = (None, None) if pose is None else (numbers(pose.time, 1), numbers(pose.value, 3))
                if stamp is not None and value is not None and self._is_near(estimate.pose, value):
                    lap.poses.append(np.array([*(stamp - self._t0), *value]))
        return replace(result, message="; ".join(filter(None, (result.message, words)))) if words else result

    def _is_near(self, believed: FloatArray, measured: FloatArray) -> bool:
        """Return True if a pose is finite and no outlier, which the estimator rejects, too."""
        distance = measured - believed
        return bool(np.hypot(*distance[:2]) < self._most_jump) and bool(np.isfinite(distance).all())

    def _learn(self, reference: Reference) -> None:
        """Learn by one step of the law above, or reset after harm or on another floor."""
        settings, lap = self._settings, self._lap
        if lap.spoilt or not lap.poses or not lap.motion or lap.motion[-1][0] < self.time[-1] - 2 * self._dt:
            self.message = f"nothing learned from the last lap: {lap.spoilt or 'it was not driven to its end'}"
            return
        motion = np.array(lap.motion)
        assert self._reference is not None
        error = self._error(self._reference, motion, np.array(lap.poses))
        gains, size = motion[:, 6:].mean(axis=0), float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        in_words = f"error {1e3 * size:.1f} mm in the last"
        if self.laps:
            change = float(np.abs(gains / self._gains - 1).max())
            if change > settings.floor_change:
                self._begin_anew(f"what was learned is forgotten: another floor, gains off by {100 * change:.0f} %")
                return
            if size > settings.worse * self._first_error:
                self._begin_anew(f"what was learned is forgotten: {in_words}, {1e3 * self._first_error:.1f} mm before")
                return
        else:
            self._first_error = size
        self.laps += 1
        share = max(settings.gain, 1 / self.laps)
        self._gains = self._gains + share * (gains - self._gains)
        news = error - self.correction[:, :2] - self._repeating
        self._spread = (1 - share) * (self._spread + share * news**2)
        self._left = (1 - share) ** 2 * self._left + share**2
        self._repeating = (1 - settings.forgetting) * (self._repeating + share * news)
        self.correction = self._bounded(-self._trust() * self._repeating, reference)
        largest = 1e3 * float(np.hypot(*self.correction.T[:2]).max())
        self.message = f"learned from {self.laps} laps, {in_words}, correction up to {largest:.1f} mm"

    def _trust(self) -> FloatArray:
        """Compute the share (n, 2) of the repeating part that exceeds the varying part, 0 to 1."""
        if self.laps == 1:
            return np.full_like(self._repeating, _FIRST_TRUST)
        variance = self._smooth(self._spread, _VARIANCE) * self._left / (1 - self._left)
        power = self._smooth(self._repeating**2, _POWER)
        return np.maximum(0.0, 1 - variance / np.maximum(power, np.finfo(float).tiny))

    def _smooth(self, rows: FloatArray, times: float = 1.0) -> FloatArray:
        """Average rows (n, m) over `times` the smoothing time."""
        width = times * self._settings.smoothing / self.time[1]
        return np.asarray(gaussian_filter1d(rows, width, axis=0, mode="nearest"))

    def _error(self, reference: Reference, motion: FloatArray, poses: FloatArray) -> FloatArray:
        """Compute the error (n, 2) of the lap along and across the reference [m], from the measured poses.

        The estimated twist, added up, has the shape of the motion but drifts; its distance from the poses, smoothed, is
        the drift.
        """
        expected = reference.sample(self.time).pose
        v, omega = (np.interp(self.time, motion[:, 0], motion[:, 4 + i]) for i in (0, 1))
        poses = poses[(poses[:, 0] >= 0) & (poses[:, 0] <= self.time[-1])]
        times_of_poses, measured = poses[:, 0], poses[:, 1:]
        near = np.interp(times_of_poses, self.time, expected[:, 2])
        theta = self._undrifted(omega, times_of_poses, near + wrap_angle(measured[:, 2] - near))
        moved = [
            self._undrifted(v * np.cos(theta), times_of_poses, measured[:, 0]),
            self._undrifted(v * np.sin(theta), times_of_poses, measured[:, 1]),
        ]
        return np.column_stack(ahead_and_left(np.column_stack(moved) - expected[:, :2], expected[:, 2]))

    def _undrifted(self, rate: FloatArray, times: FloatArray, measured: FloatArray) -> FloatArray:
        """Integrate `rate` (n,), corrected to agree with `measured` (m,) at `times` (m,)."""
        step = float(self.time[1])
        shape = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])
        place = np.clip(np.rint(times / step).astype(int), 0, len(shape) - 1)
        sums = np.zeros((len(shape), 2))
        np.add.at(sums, place, np.column_stack([measured - np.interp(times, self.time, shape), np.ones_like(times)]))
        # Far enough to reach a pose anywhere: its weight is small, but it is the only one.
        width = self._settings.smoothing / step
        distance, count = gaussian_filter1d(sums, width, axis=0, mode="constant", truncate=30.0).T
        return np.asarray(shape + distance / np.maximum(count, np.finfo(float).tiny))

    def _bounded(self, moved: FloatArray, reference: Reference) -> FloatArray:
        """Compute the correction (n, 3) for a motion (n, 2): smooth, inside its bounds, and zero at the start."""
        settings, step = self._settings, self.time[1]
        moved = self._smooth(moved) * np.minimum(1.0, self.time / (2 * settings.smoothing))[:, None]
        size = np.hypot(*moved.T)[:, None]
        moved = moved * np.minimum(1.0, settings.max_correction / np.maximum(size, settings.max_correction))
        rate = float(np.hypot(*np.gradient(moved, step, axis=0).T).max())
        moved = moved * min(1.0, settings.max_correction_rate / max(rate, settings.max_correction_rate))
        v = reference.sample(self.time).twist[:, 0]
        # Along the moved path; a robot that stands or turns on the spot cannot follow to the side.
        turned = np.gradient(moved[:, 1], step) * v / (v**2 + SLOW**2)
        return np.column_stack(
            [moved, np.clip(turned, -settings.max_heading_correction, settings.max_heading_correction)]
        )


def same_motion(first: Reference, second: Reference) -> bool:
    """Return True if both are the same motion, even in another place; False for `LONGEST` or more."""
    if abs(first.duration - second.duration) >= _SAME or first.duration > LONGEST:
        return False
    times = np.linspace(0.0, first.duration, max(int(first.duration / _INSTANT), 1) + 1)
    return bool(np.allclose(first.sample(times).twist, second.sample(times).twist, rtol=0.0, atol=_SAME))


def corrected(reference: Reference, time: FloatArray, correction: FloatArray) -> SplineTrajectory:
    """Move `reference` by `correction` (n, 3) along and across itself [m] and in heading [rad] at times (n,)."""
    plain = reference.sample(time)
    heading, (v, omega) = plain.pose[:, 2], plain.twist.T
    change = np.column_stack([*ahead_and_left(correction, -heading), correction[:, 2]])
    rate = np.column_stack([v * np.cos(heading), v * np.sin(heading), omega])
    rate += np.gradient(change, time[1] - time[0], axis=0)
    return SplineTrajectory.through(reference.name, time, plain.pose + change, rate)
