"""Rehearsal by the slip of the surface: track a reference that is drivable with the learned slip.

The learned slip is the mean of the estimates of all ticks of a lap, weighted by the inverse variance. At the next start
of any reference, it is the initial estimate of the slip, and the controller tracks the nearest drivable motion
(`drivable.py`). Errors are still computed against the original reference.
"""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import ahead_and_left
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.constants import configured_slip
from diffdrive_mpc.mpc.problem.slip import SLIPS, Slip
from diffdrive_mpc.mpc.step_result import Mode, StepResult
from diffdrive_mpc_extras.rehearsal.config import rehearsal_of
from diffdrive_mpc_extras.rehearsal.drivable import Drivable, NotDrivableError, nearest_drivable
from diffdrive_mpc_extras.rehearsal.rehearsal import same_motion

_DRIVING = (Mode.TRACKING, Mode.REUSED_PLAN)
# Maximum duration of a reference for which a drivable path is computed [s]; memory grows by 0.8 MB per second.
_MAX_DURATION = 600.0
_UNCHANGED = "the reference is tracked unchanged"


class FloorRehearsal:
    """Learner of the slip that returns the drivable reference at each start; same interface as `LapLearner`.

    Parameters
    ----------
    config
        Configuration of the controller.
    inverse_gain
        (2, 2) inverse of the velocity model's steady-state gain.

    Attributes
    ----------
    config
        Current configuration; a change takes effect at the next start.
    laps
        Number of laps from which the slip was learned.
    slip
        Learned slip, with which the next estimate starts; its offset has the configured value.
    time
        (n,) times of the correction [s].
    correction
        (n, 3) distance of the tracked motion from the original reference along and across it [m], and the difference of
        heading [rad].
    message
        Result of the last start as a text.
    """

    def __init__(self, config: ControllerConfig, inverse_gain: FloatArray) -> None:
        self.config, self._inverse_gain = config, inverse_gain
        self.forget()

    def forget(self) -> None:
        """Reset to the initial state."""
        self._reference: Reference | None = None
        self._unchanged_error = np.inf
        self._discard("")
        self._start_lap(0.0)

    def _discard(self, reason: str) -> None:
        self.laps, self.slip, self.message = 0, configured_slip(self.config), reason

    def _start_lap(self, t0: float) -> None:
        self._t0, self._is_reported = t0, False
        self.time: FloatArray = np.zeros(1)
        self.correction: FloatArray = np.zeros((1, 3))
        self._weighted_sum, self._weight = np.zeros(len(SLIPS)), np.zeros(len(SLIPS))
        self._poses: list[tuple[float, ...]] = []

    def start(self, reference: Reference, t0: float) -> Reference:
        """Learn from the last lap, and prepare the next lap, which starts at time `t0` [s].

        Returns
        -------
        Reference
            Motion to track: the drivable motion nearest to `reference`, or `reference` itself if no slip is learned,
            if the shift is negligible, or if no motion is found. `message` states the case.
        """
        self.message = ""
        if self._poses and self._reference is not None:
            self._learn(self._reference)
        if self._reference is None or not same_motion(self._reference, reference):
            self._unchanged_error = np.inf
        self._reference = reference
        self._start_lap(t0)
        drivable = self._plan_motion(reference) if self.laps else None
        if drivable is None:
            return reference
        offset, heading = drivable.pose - drivable.reference.pose, drivable.reference.pose[:, 2]
        self.time, self.correction = drivable.times, np.column_stack([*ahead_and_left(offset, heading), offset[:, 2]])
        return drivable.as_reference(reference.name, rehearsal_of(self.config).smoothing)

    def take(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick at `t` [s]; return `result`, with `message` added at the first tick of a lap."""
        del measurement
        note = f"rehearsal: {self.message}" if self.message and not self._is_reported else ""
        self._is_reported = True
        estimate = result.estimate
        if estimate is not None and result.mode in _DRIVING:
            deviation = np.array(astuple(estimate.slip_deviation))
            weight = np.divide(1.0, deviation**2, out=np.zeros_like(deviation), where=deviation > 0.0)
            self._weighted_sum += weight * astuple(estimate.slip)
            self._weight += weight
            self._poses.append((t - self._t0, *estimate.pose.tolist()))
        return replace(result, message="; ".join(filter(None, (result.message, note)))) if note else result

    def _learn(self, reference: Reference) -> None:
        """Update the slip by its weighted mean over the lap; the lap's estimate includes the earlier laps."""
        times, *pose = np.array(self._poses).T
        if times[-1] > reference.duration - 2 * self.config.sample_time:
            deviation = np.array(pose).T - reference.sample(times).pose
            error = float(np.sqrt(np.mean(np.sum(deviation[:, :2] ** 2, axis=1))))
            if not self.correction.any():
                self._unchanged_error = error
            elif error > rehearsal_of(self.config).worse * self._unchanged_error:
                comparison = f"{1e3 * self._unchanged_error:.1f} mm with the unchanged reference"
                self._discard(f"learned values are discarded: error {1e3 * error:.1f} mm, {comparison}")
                return
        mean = np.array(astuple(self.slip))
        np.divide(self._weighted_sum, self._weight, out=mean, where=self._weight > 0.0)
        self.slip = replace(Slip(*mean.tolist()), v_offset=self.slip.v_offset)
        self.laps += 1

    def _plan_motion(self, reference: Reference) -> Drivable | None:
        """Compute the motion to track instead of `reference`, or None to track `reference`; set `message`."""
        bounds, learned = rehearsal_of(self.config).drivable, f"slip learned from {self.laps} laps"
        if reference.duration > _MAX_DURATION:
            self.message = f"{learned}, {_UNCHANGED}: it is longer than {_MAX_DURATION:g} s"
            return None
        try:
            drivable = nearest_drivable(reference, self.slip, self.config, self._inverse_gain)
        except NotDrivableError as error:
            self.message = f"{learned}, {_UNCHANGED}: {error}"
            return None
        max_shift = float(drivable.distance.max())
        distance = (
            f"{1e3 * np.sqrt(np.mean(drivable.distance**2)):.1f} mm RMS and {1e3 * max_shift:.1f} mm maximum distance"
        )
        if bounds.min_shift < max_shift <= bounds.max_shift:
            self.message = f"{learned}; the nearest drivable path is tracked: {distance}"
            return drivable
        self.message = f"{learned}, {_UNCHANGED}: the nearest drivable path has {distance}"
        return None
