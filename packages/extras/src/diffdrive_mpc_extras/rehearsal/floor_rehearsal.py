"""Rehearsal by the floor: the learned slip becomes a reference that can be driven there.

The estimate of slip is taken from each tick of a lap, weighted by how certain it is. At the next start, of any
reference, the estimate begins with it, and the motion nearest to the reference that the floor allows is tracked in its
place (`drivable.py`); errors still count against the reference as it was given.
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
# Longest reference for which a path that can be driven is searched [s]: memory grows by 0.8 MB for each second.
_LONGEST = 600.0
_AS_GIVEN = "the reference is tracked as it is given"


class FloorRehearsal:
    """Learns slip, and gives each start of a reference the one to track; stands in for `Rehearsal`.

    Parameters
    ----------
    config
        Its group rehearsal, and what the path depends on.
    inverse_gain
        (2, 2) inverse of the velocity model's steady-state gain.

    Attributes
    ----------
    config
        The one in force; another one counts from the next start.
    laps
        From how many laps slip was learned.
    slip
        Learned slip, with which the next estimate begins; its offset is not of the floor and stays as configured.
    time
        (n,) times of the reference [s] at which the correction is kept.
    correction
        (n, 3) by how much the motion to track lies along and across the given reference [m], and the robot is turned
        against it [rad].
    said
        Preparation of the last start, in words.
    """

    def __init__(self, config: ControllerConfig, inverse_gain: FloatArray) -> None:
        self.config, self._inverse_gain = config, inverse_gain
        self.forget()

    def forget(self) -> None:
        """Reset to the initial state."""
        self._reference: Reference | None = None
        self._error_as_given = np.inf
        self._begin_anew("")
        self._begin_lap(0.0)

    def _begin_anew(self, why: str) -> None:
        self.laps, self.slip, self.message = 0, configured_slip(self.config), why

    def _begin_lap(self, t0: float) -> None:
        self._t0, self._told = t0, False
        self.time: FloatArray = np.zeros(1)
        self.correction: FloatArray = np.zeros((1, 3))
        self._weighted, self._weight = np.zeros(len(SLIPS)), np.zeros(len(SLIPS))
        self._driven: list[tuple[float, ...]] = []

    def start(self, reference: Reference, t0: float) -> Reference:
        """Learn from what was driven since the last start, and prepare the next lap, whose time 0 is `t0` [s].

        Returns
        -------
        Reference
            What to track: the motion nearest to `reference` that can be driven, or `reference` itself where nothing is
            known of the floor, where it need not be moved, and where no such motion is found; `said` says which.
        """
        self.message = ""
        if self._driven and self._reference is not None:
            self._learn(self._reference)
        if self._reference is None or not same_motion(self._reference, reference):
            self._error_as_given = np.inf
        self._reference = reference
        self._begin_lap(t0)
        drivable = self._prepared(reference) if self.laps else None
        if drivable is None:
            return reference
        beside, heading = drivable.pose - drivable.reference.pose, drivable.reference.pose[:, 2]
        self.time, self.correction = drivable.times, np.column_stack([*ahead_and_left(beside, heading), beside[:, 2]])
        return drivable.as_reference(reference.name, rehearsal_of(self.config).smoothing)

    def take(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Learn from the tick at `t` [s]; returns `result`, at the first tick with the preparation in its message."""
        del measurement
        words = f"rehearsal: {self.message}" if self.message and not self._told else ""
        self._told = True
        estimate = result.estimate
        if estimate is not None and result.mode in _DRIVING:
            deviation = np.array(astuple(estimate.slip_deviation))
            weight = np.divide(1.0, deviation**2, out=np.zeros_like(deviation), where=deviation > 0.0)
            self._weighted += weight * astuple(estimate.slip)
            self._weight += weight
            self._driven.append((t - self._t0, *estimate.pose.tolist()))
        return replace(result, message="; ".join(filter(None, (result.message, words)))) if words else result

    def _learn(self, reference: Reference) -> None:
        """Learn the mean slip of a lap; the lap started from the learned slip, so earlier laps are included."""
        times, *pose = np.array(self._driven).T
        if times[-1] > reference.duration - 2 * self.config.sample_time:
            off = np.array(pose).T - reference.sample(times).pose
            error = float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))
            if not self.correction.any():
                self._error_as_given = error
            elif error > rehearsal_of(self.config).worse * self._error_as_given:
                before = f"{1e3 * self._error_as_given:.1f} mm as it was given"
                self._begin_anew(f"what was learned is forgotten: error {1e3 * error:.1f} mm, {before}")
                return
        mean = np.array(astuple(self.slip))
        np.divide(self._weighted, self._weight, out=mean, where=self._weight > 0.0)
        self.slip = replace(Slip(*mean.tolist()), v_offset=self.slip.v_offset)
        self.laps += 1

    def _prepared(self, reference: Reference) -> Drivable | None:
        """Compute the motion to track instead of `reference`, if there is one, and describe the result."""
        bounds, learned = rehearsal_of(self.config).drivable, f"slip learned from {self.laps} laps"
        if reference.duration > _LONGEST:
            self.message = f"{learned}, {_AS_GIVEN}: it is longer than {_LONGEST:g} s"
            return None
        try:
            drivable = nearest_drivable(reference, self.slip, self.config, self._inverse_gain)
        except NotDrivableError as error:
            self.message = f"{learned}, {_AS_GIVEN}: {error}"
            return None
        most = float(drivable.distance.max())
        distance = f"{1e3 * np.sqrt(np.mean(drivable.distance**2)):.1f} mm beside it, {1e3 * most:.1f} mm at most"
        if bounds.min_shift < most <= bounds.max_shift:
            self.message = f"{learned}; the path nearest to the reference that can be driven is tracked: {distance}"
            return drivable
        self.message = f"{learned}, {_AS_GIVEN}: what can be driven lies {distance}"
        return None
