"""Iterative learning: correct the reference of the next lap by the errors of the previous laps.

Model errors in starts, stops and curves repeat on each lap of a path. Feedback reacts only after such an error, but on
a repeated path the error is known in advance. The controller then tracks the reference with a correction c along and
across the path, as a function of its time. The robot follows slow changes of its reference, so the error of a lap is
e = d + c with the repeating part d. After lap k

    d <- (1 - forgetting) (d + max(gain, 1 / k) (e - c - d)),    c = -Q trust d

In the first laps, 1 / k makes d the mean of all laps. `trust` is the reliable part of d, as in a Wiener filter:
1 - variance of d / local power of d. Q is a zero-phase filter, because the robot does not follow fast changes. Source
(iterative learning control with a Q-filter): Bristow, Tharayil, Alleyne, IEEE Control Systems Magazine 26(3), 2006.
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

# Trust after the first lap, when the variation from lap to lap is unknown.
_FIRST_TRUST = 0.5
# Averaging times of power and variance, in multiples of the smoothing time.
_POWER, _VARIANCE = 6, 20
# Tolerance of the twists of equal references [m/s, rad/s], and interval of the comparison [s].
_TOLERANCE, _INTERVAL = 1e-6, 0.02
MAX_DURATION = 3600.0
"""Maximum duration of a reference for learning [s]; memory and start time grow with the duration."""
_DRIVING = (Mode.TRACKING, Mode.REUSED_PLAN, Mode.FINISHED)


@dataclass
class _Lap:
    """Record of a lap since its start."""

    motion: list[FloatArray] = field(default_factory=list)
    """(8,) time [s], estimated pose x, y [m], theta [rad], estimated twist [m/s, rad/s], both slip gains."""
    poses: list[FloatArray] = field(default_factory=list)
    """(4,) time [s], measured pose x, y [m], theta [rad], without the stated delay and heading of the sensor."""
    fault: str = ""
    """Reason why the lap is not used for learning; empty if it is used."""


class LapLearner:
    """Recorder of laps that returns the corrected reference at each start.

    Parameters
    ----------
    config
        Configuration of the controller.

    Attributes
    ----------
    laps
        Number of laps from which the correction was learned.
    time
        (n,) times of the correction [s].
    correction
        (n, 3) distance of the tracked reference from the original along and across it [m], and the difference of
        heading [rad].
    message
        Learning result of the last start as a text.
    """

    def __init__(self, config: ControllerConfig) -> None:
        self._settings, self._dt = rehearsal_of(config), config.sample_time
        self._max_jump, self._response = config.estimator.max_position_jump, config.sensors.pose
        self.forget()

    def forget(self) -> None:
        """Reset to the initial state."""
        self._reference: Reference | None = None
        self._lap, self._t0, self._is_reported = _Lap(), 0.0, False
        self.time: FloatArray = np.empty(0)
        self._discard("")

    def _discard(self, reason: str) -> None:
        count = len(self.time)
        self.laps, self.message = 0, reason
        self.correction: FloatArray = np.zeros((count, 3))
        # Repeating part, variance from lap to lap, and the factor from this variance to the variance of the mean.
        self._repeating, self._lap_variance, self._mean_weight = np.zeros((count, 2)), np.zeros((count, 2)), 0.0
        self._gains: FloatArray = np.ones(2)
        self._first_error = np.inf

    def start(self, reference: Reference, t0: float) -> Reference:
        """Learn from the last lap, and start the next lap at time `t0` [s].

        Returns
        -------
        Reference
            Reference to track: `reference` with the correction, or unchanged if nothing is learned. A reference with
            equal twists at another pose counts as the same reference.
        """
        if self._reference is not None and same_motion(self._reference, reference):
            self._learn(reference)
        elif not self._dt <= reference.duration <= MAX_DURATION:
            self.time = np.empty(0)
            self._discard(f"no learning for a reference that is shorter than a tick or longer than {MAX_DURATION:g} s")
        else:
            count = max(int(np.ceil(reference.duration / self._dt)), 1) + 1
            self.time = np.linspace(0.0, reference.duration, count)
            self._discard("")
        self._reference, self._lap, self._t0, self._is_reported = reference, _Lap(), t0, False
        return corrected(reference, self.time, self.correction) if self.correction.any() else reference

    def take(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick at `t` [s]; return `result`, with `message` added at the first tick of a lap."""
        lap, now = self._lap, t - self._t0
        note = f"rehearsal: {self.message}" if self.message and not self._is_reported else ""
        self._is_reported = True
        # Record nothing between a reset and the next start.
        if self.time.size and now <= self.time[-1] + self._dt and not lap.fault:
            estimate = result.estimate
            if estimate is None or result.mode not in _DRIVING or result.reference_delay != 0.0:
                lap.fault = f"at {now:.2f} s the mode was {result.mode}, {result.reference_delay:.2f} s late"
            else:
                lap.motion.append(np.concatenate([[now], estimate.pose, estimate.twist, estimate.slip.gains]))
                pose = measurement.pose
                stamp, value = (None, None) if pose is None else (numbers(pose.time, 1), numbers(pose.value, 3))
                if stamp is not None and value is not None and self._is_near(estimate.pose, value):
                    # Time and heading as the estimator corrects them, so that the error is that of the robot.
                    time, (x, y, theta) = stamp[0] - self._t0 - self._response.delay, value
                    lap.poses.append(np.array([time, x, y, theta - self._response.heading]))
        return replace(result, message="; ".join(filter(None, (result.message, note)))) if note else result

    def _is_near(self, estimated: FloatArray, measured: FloatArray) -> bool:
        """Return True if a pose is finite and within the jump limit of the estimator."""
        distance = measured - estimated
        return bool(np.hypot(*distance[:2]) < self._max_jump) and bool(np.isfinite(distance).all())

    def _learn(self, reference: Reference) -> None:
        """Update the correction by one step, or discard it if the error grew or the surface changed."""
        settings, lap = self._settings, self._lap
        if lap.fault or not lap.poses or not lap.motion or lap.motion[-1][0] < self.time[-1] - 2 * self._dt:
            self.message = f"nothing learned from the last lap: {lap.fault or 'it is incomplete'}"
            return
        motion = np.array(lap.motion)
        assert self._reference is not None
        error = self._error(self._reference, motion, np.array(lap.poses))
        gains, size = motion[:, 6:].mean(axis=0), float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        error_text = f"measured error {1e3 * size:.1f} mm in the last lap"
        if self.laps:
            change = float(np.abs(gains / self._gains - 1).max())
            if change > settings.floor_change:
                self._discard(f"correction discarded: surface changed, slip gains differ by {100 * change:.0f} %")
                return
            if size > settings.worse * self._first_error:
                self._discard(f"correction discarded: {error_text}, {1e3 * self._first_error:.1f} mm in the first")
                return
        else:
            self._first_error = size
        self.laps += 1
        weight = max(settings.gain, 1 / self.laps)
        self._gains = self._gains + weight * (gains - self._gains)
        innovation = error - self.correction[:, :2] - self._repeating
        self._lap_variance = (1 - weight) * (self._lap_variance + weight * innovation**2)
        self._mean_weight = (1 - weight) ** 2 * self._mean_weight + weight**2
        self._repeating = (1 - settings.forgetting) * (self._repeating + weight * innovation)
        self.correction = self._bounded_correction(-self._trust() * self._repeating, reference)
        max_correction = 1e3 * float(np.hypot(*self.correction.T[:2]).max())
        count = "1 lap" if self.laps == 1 else f"{self.laps} laps"
        self.message = f"learned from {count}, {error_text}, correction up to {max_correction:.1f} mm"

    def _trust(self) -> FloatArray:
        """Compute the reliable fraction (n, 2) of the repeating part, 0 to 1."""
        if self.laps == 1:
            return np.full_like(self._repeating, _FIRST_TRUST)
        variance = self._smooth(self._lap_variance, _VARIANCE) * self._mean_weight / (1 - self._mean_weight)
        power = self._smooth(self._repeating**2, _POWER)
        return np.maximum(0.0, 1 - variance / np.maximum(power, np.finfo(float).tiny))

    def _smooth(self, rows: FloatArray, times: float = 1.0) -> FloatArray:
        """Smooth rows (n, m) over `times` times the smoothing time."""
        width = times * self._settings.smoothing / self.time[1]
        return np.asarray(gaussian_filter1d(rows, width, axis=0, mode="nearest"))

    def _error(self, reference: Reference, motion: FloatArray, poses: FloatArray) -> FloatArray:
        """Compute the error (n, 2) of the lap along and across the reference [m], from the measured poses.

        The integral of the estimated twist has the shape of the motion but drifts. The drift is the smoothed difference
        from the measured poses.
        """
        expected = reference.sample(self.time).pose
        v, omega = (np.interp(self.time, motion[:, 0], motion[:, 4 + i]) for i in (0, 1))
        poses = poses[(poses[:, 0] >= 0) & (poses[:, 0] <= self.time[-1])]
        pose_times, measured = poses[:, 0], poses[:, 1:]
        reference_heading = np.interp(pose_times, self.time, expected[:, 2])
        theta = self._corrected_integral(
            omega, pose_times, reference_heading + wrap_angle(measured[:, 2] - reference_heading)
        )
        position = [
            self._corrected_integral(v * np.cos(theta), pose_times, measured[:, 0]),
            self._corrected_integral(v * np.sin(theta), pose_times, measured[:, 1]),
        ]
        return np.column_stack(ahead_and_left(np.column_stack(position) - expected[:, :2], expected[:, 2]))

    def _corrected_integral(self, rate: FloatArray, times: FloatArray, measured: FloatArray) -> FloatArray:
        """Integrate `rate` (n,) and remove the drift relative to `measured` (m,) at `times` (m,)."""
        step = float(self.time[1])
        shape = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])
        index = np.clip(np.rint(times / step).astype(int), 0, len(shape) - 1)
        sums = np.zeros((len(shape), 2))
        np.add.at(sums, index, np.column_stack([measured - np.interp(times, self.time, shape), np.ones_like(times)]))
        # The wide truncation reaches a distant pose if no other pose is near.
        width = self._settings.smoothing / step
        distance, count = gaussian_filter1d(sums, width, axis=0, mode="constant", truncate=30.0).T
        return np.asarray(shape + distance / np.maximum(count, np.finfo(float).tiny))

    def _bounded_correction(self, shift: FloatArray, reference: Reference) -> FloatArray:
        """Compute the correction (n, 3) from a shift (n, 2): smooth, within its bounds, and zero at the start."""
        settings, step = self._settings, self.time[1]
        shift = self._smooth(shift) * np.minimum(1.0, self.time / (2 * settings.smoothing))[:, None]
        size = np.hypot(*shift.T)[:, None]
        shift = shift * np.minimum(1.0, settings.max_correction / np.maximum(size, settings.max_correction))
        rate = float(np.hypot(*np.gradient(shift, step, axis=0).T).max())
        shift = shift * min(1.0, settings.max_correction_rate / max(rate, settings.max_correction_rate))
        v = reference.sample(self.time).twist[:, 0]
        # Heading of the corrected path; zero for a robot that stands or turns on the spot, which cannot move sideways.
        rotation = np.gradient(shift[:, 1], step) * v / (v**2 + SLOW**2)
        return np.column_stack(
            [shift, np.clip(rotation, -settings.max_heading_correction, settings.max_heading_correction)]
        )


def same_motion(first: Reference, second: Reference) -> bool:
    """Return True if both references have equal twists; False for durations above `MAX_DURATION`."""
    if abs(first.duration - second.duration) >= _TOLERANCE or first.duration > MAX_DURATION:
        return False
    times = np.linspace(0.0, first.duration, max(int(first.duration / _INTERVAL), 1) + 1)
    return bool(np.allclose(first.sample(times).twist, second.sample(times).twist, rtol=0.0, atol=_TOLERANCE))


def corrected(reference: Reference, time: FloatArray, correction: FloatArray) -> SplineTrajectory:
    """Shift `reference` by `correction` (n, 3), along and across it [m] and in heading [rad], at times (n,)."""
    plain = reference.sample(time)
    heading, (v, omega) = plain.pose[:, 2], plain.twist.T
    change = np.column_stack([*ahead_and_left(correction, -heading), correction[:, 2]])
    rate = np.column_stack([v * np.cos(heading), v * np.sin(heading), omega])
    rate += np.gradient(change, time[1] - time[0], axis=0)
    return SplineTrajectory.through(reference.name, time, plain.pose + change, rate)
