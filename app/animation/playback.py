"""What a film shows of a drive, whether it comes from a run, its log, or the log of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.interface import FloatArray, ReferenceSample
from diffdrive_mpc.models.results import ReadOnlyArrays
from diffdrive_mpc.sim.metrics.tracking_errors import tracking_errors

NO_PLANS: FloatArray = np.empty((0, 0, 3))


@dataclass(frozen=True)
class Playback(ReadOnlyArrays):
    """A drive of n instants. What is not known is empty, what is not known at an instant NaN.

    Attributes
    ----------
    time
        (n,) increasing [s].
    pose
        (n, 3) where the robot was: x, y [m], theta [rad, unwrapped].
    command
        (n, 2) v [m/s], omega [rad/s] sent.
    twist
        (n, 2) v [m/s], omega [rad/s] of the robot.
    told
        What `pose` and `twist` are: "true", "estimated" or "measured".
    arrived
        (n, 3) poses as the sensor gave them, at the instants at which they arrived; or (0, 3).
    reference
        (n, 3) where it should have been; or (0, 3).
    position_error, lateral_error
        (n,) distance to the reference at the same time, and signed distance from its path [m]; or (0,).
    wheel_speeds
        (n, 4) measured, front left, front right, rear left, rear right [rad/s]; or (0, 4).
    plans
        (n, p, 3) poses that the controller predicted; or (0, 0, 3).
    limits
        (2,) largest v [m/s] and omega [rad/s] that are commanded; None where they are not known.
    modes, messages
        What the controller said; or empty.
    plant, surface
        Which robot and floor it was, as `make_plant` calls them; None where that is not known.
    """

    time: FloatArray
    pose: FloatArray
    command: FloatArray
    twist: FloatArray
    told: str
    arrived: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    reference: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    position_error: FloatArray = field(default_factory=lambda: np.empty(0))
    lateral_error: FloatArray = field(default_factory=lambda: np.empty(0))
    wheel_speeds: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    plans: FloatArray = field(default_factory=lambda: NO_PLANS)
    limits: tuple[float, float] | None = None
    modes: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    plant: str | None = None
    surface: str | None = None

    def at(self, times: FloatArray) -> FloatArray:
        """(m, 3) poses at `times` (m,) [s], between two instants on the straight way; NaN where none is known."""
        known = np.isfinite(self.pose).all(axis=1)
        time, pose = self.time[known], self.pose[known]
        poses = np.column_stack([np.interp(times, time, column) for column in pose.T])
        poses[np.isnan(self.pose[self.instants(times)]).any(axis=1)] = np.nan
        return poses

    def instants(self, times: FloatArray) -> NDArray[np.intp]:
        """(m,) index of the last instant at or before each of `times` (m,) [s]."""
        return np.maximum(np.searchsorted(self.time, times + 1e-9, side="right") - 1, 0)


def from_columns(
    columns: Mapping[str, NDArray[Any]],
    plans: FloatArray = NO_PLANS,
    limits: tuple[float, float] | None = None,
) -> Playback:
    """The playback of a drive by `Run.columns`, which a log of it holds, too; `plans` (n, p, 3) where they were kept.

    On a robot nobody knows the true pose: there it is the estimated one that is shown.
    """

    def rows(*names: str) -> FloatArray:
        return np.column_stack([np.asarray(columns[name], dtype=float) for name in names])

    def poses(of: str) -> FloatArray:
        return rows(f"{of}_x_m", f"{of}_y_m", f"{of}_theta_rad")

    time, pose, reference = rows("t_s")[:, 0], poses("true"), poses("reference")
    twist = rows("true_v_m_s", "true_lateral_m_s", "true_omega_rad_s")
    simulated = bool(np.isfinite(pose).any())
    if not simulated:
        pose, twist = poses("estimate"), rows("estimate_v_m_s", "estimate_v_m_s", "estimate_omega_rad_s")
        twist[:, 1] = 0.0
    tracked = np.isfinite(reference).all(axis=1) & np.isfinite(pose).all(axis=1)
    position_error, lateral_error = np.full((2, len(time)), np.nan)
    if tracked.sum() > 1:
        reference_samples = ReferenceSample(
            reference[tracked], rows("reference_v_m_s", "reference_omega_rad_s")[tracked], _arc(reference[tracked])
        )
        along = RecordedReference(time[tracked], reference_samples)
        errors = tracking_errors(along, reference_samples, pose[tracked], twist[tracked])
        position_error[tracked], lateral_error[tracked] = errors.position, errors.lateral
    return Playback(
        time=time,
        pose=pose,
        command=rows("v_ref_m_s", "omega_ref_rad_s"),
        twist=twist[:, [0, 2]],
        told="true" if simulated else "estimated",
        arrived=poses("pose"),
        reference=reference,
        position_error=position_error,
        lateral_error=lateral_error,
        wheel_speeds=rows(*(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr"))),
        plans=plans,
        limits=limits,
        modes=tuple(columns["mode"]),
        messages=tuple(columns["message"]),
    )


def _arc(poses: FloatArray) -> FloatArray:
    """(n,) way along `poses` (n, 3) since the first [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


class RecordedReference:
    """As much of a reference as a log tells: where it was at each tick. See `models.interface.Reference`."""

    name = "recorded"

    def __init__(self, time: FloatArray, reference: ReferenceSample) -> None:
        self._time, self._samples = time, reference

    @property
    def duration(self) -> float:
        """Time of the last tick [s]."""
        return float(self._time[-1])

    def sample(self, times: Any) -> ReferenceSample:  # noqa: ANN401 - ArrayLike
        """Between two ticks on the straight line."""
        reference = self._samples
        pose, twist = (
            np.column_stack([np.interp(times, self._time, column) for column in rows.T])
            for rows in (reference.pose, reference.twist)
        )
        return ReferenceSample(pose, twist, np.interp(times, self._time, reference.arc_length))
