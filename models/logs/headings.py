"""Headings of a robot with measured positions only (motion capture of one marker, RTK, beacons).

The motion is predicted from gyro and encoders, or from the commands if both are missing. Gain, dead time and two lags
of v and omega are fitted to the positions, with an unknown start pose in each window. The heading is the prediction
plus a random walk, smoothed with the positions (Rauch, Tung, Striebel, AIAA Journal 1965, 3(8), 1445-1450; solved here
as one sparse least-squares problem).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import AnyArray, FloatArray
from diffdrive_mpc.models.logs.diagnosis.streams import interpolate_missing
from diffdrive_mpc.models.logs.record import Finding, MappingChange, Record

_WINDOWS = (2.0, 6.0)
"""Window durations of the first and the final fit [s]; a poor initial gain requires short windows."""
# Bounds of the parameters: gain, dead time [s] and two lags [s] of v and of omega, and position of the measured point
# ahead and to the left of the robot's origin [m].
_LOWER_BOUNDS = np.array([0.05, -0.3, 1e-3, 1e-3, -3.0, -0.3, 1e-3, 1e-3, -2.0, -2.0])
_UPPER_BOUNDS = np.array([3.0, 0.8, 1.0, 1.0, 3.0, 0.8, 1.0, 1.0, 2.0, 2.0])
_SCALE = np.array([1.0, 0.1, 0.1, 0.1, 1.0, 0.1, 0.1, 0.1, 0.1, 0.1])
_INITIAL_PARAMETERS = [np.array([0.9, 0.1, 0.15, 0.02, gain, 0.1, 0.15, 0.02, 0.0, 0.0]) for gain in (0.5, 0.9, -0.9)]
_OMEGA_GAIN = 4
"""Index of the gain of omega, which is negative for mirrored positions."""
_MAX_EVALUATIONS = (10, 20)
_COST_TOLERANCE = 1e-5
"""Relative decrease of the cost below which the search stops."""
_DISTURBANCES = (0.05, 0.3)
"""Standard deviations of travel [m] and heading [rad] relative to the prediction after 1 s."""
_ITERATIONS = 4  # of Gauss-Newton, for each smoothed record
_MAX_ROWS = 30_000
_MIN_POSITIONS = 20


class _Positions(NamedTuple):
    """Inputs v, omega (K, 2), sample time [s], rows (n,) with a position, and positions x + iy (n,) [m]."""

    inputs: FloatArray
    dt: float
    rows: AnyArray
    measured: AnyArray


def with_headings(log: str, records: Sequence[Record]) -> tuple[list[Record], list[Finding]]:
    """Return records with headings computed from the positions, and findings.

    Parameters
    ----------
    log
        Name of the log.
    records
        Records with x and y of poses. The result has computed theta and corrected mirrored positions; poses of records
        with few positions are removed.
    """
    data = [_positions(record) for record in records]
    sensors = [
        name
        for name, field in (("gyro", "yaw_rate"), ("encoders", "twist"))
        if all(getattr(record, field) is not None for record in records)
    ]
    source = " and ".join(sensors) or "commands"
    message = f"the poses have no heading: it is computed from positions and {source}"
    usable = [part for part in data if part is not None]
    findings = [Finding("computed heading", "note", log, message)]
    if not sensors:
        message += (
            "; the sign of the command defines the forward direction, and a controller needs a gyro or encoders in "
            "addition to such poses"
        )
        findings = [Finding("no heading", "warning", log, message)]
    parameters = _fit(usable) if usable else _INITIAL_PARAMETERS[0]
    side = float(np.sign(parameters[_OMEGA_GAIN]))
    if side < 0:
        message = (
            f"the positions turn in the opposite direction to the {source}: they are mirrored, or x and y are exchanged"
        )
        findings.append(Finding("mirrored pose", "error", log, message, changes=(MappingChange("pose", "y.sign", -1),)))
        # Mirroring y also mirrors the lateral offset of the measured point.
        parameters = parameters * np.where(
            np.isin(np.arange(len(parameters)), (_OMEGA_GAIN, len(parameters) - 1)), -1.0, 1.0
        )
    results: list[Record] = []
    for record, part in zip(records, data, strict=True):
        if part is None or record.pose is None:
            results.append(replace(record, pose=None, fresh_pose=None))
            continue
        corrected = part._replace(measured=part.measured.real + 1j * side * part.measured.imag)
        pose = np.column_stack([record.pose[:, :2] * [1.0, side], _smooth_headings(corrected, parameters)])
        results.append(replace(record, pose=pose))
    return results, findings


def _positions(record: Record) -> _Positions | None:
    if record.pose is None or record.fresh_pose is None or record.fresh_pose.sum() < _MIN_POSITIONS:
        return None
    rows = np.flatnonzero(record.fresh_pose)
    v, omega = (record.command if record.twist is None else record.twist).T
    inputs = [v, omega if record.yaw_rate is None else record.yaw_rate]
    if not all(np.isfinite(values).any() for values in inputs):
        return None
    return _Positions(
        interpolate_missing(np.column_stack(inputs)), record.dt, rows, record.pose[rows, :2] @ [1.0, 1.0j]
    )


def _fit(data: Sequence[_Positions]) -> FloatArray:
    """Fit the parameters of the prediction to the positions; each window is aligned by a rotation and translation."""
    from scipy.optimize import least_squares  # noqa: PLC0415 - loads slowly

    parts = [part for i, part in enumerate(data) if not i or sum(len(p.inputs) for p in data[:i]) < _MAX_ROWS]

    def residuals(parameters: FloatArray, window: float) -> FloatArray:
        errors = []
        for part in parts:
            measured, predicted, turn = _align_windows(part, _predict_motion(part, parameters)[1], window)
            errors.append(measured - predicted * turn)
        return np.concatenate(errors).view(float)

    best = min(_INITIAL_PARAMETERS, key=lambda start: float(np.sum(residuals(start, _WINDOWS[0]) ** 2)))
    for window, evaluations in zip(_WINDOWS, _MAX_EVALUATIONS, strict=True):
        best = least_squares(
            residuals,
            best,
            bounds=(_LOWER_BOUNDS, _UPPER_BOUNDS),
            x_scale=_SCALE,
            max_nfev=evaluations,
            ftol=_COST_TOLERANCE,
            args=(window,),
        ).x
    return np.asarray(best)


def _predict_motion(part: _Positions, parameters: FloatArray) -> tuple[FloatArray, AnyArray]:
    """Predict headings (K,) [rad] and positions x + iy (n,) [m] of the measured point from a start at zero."""
    v, omega = (_response(part.inputs[:, i], part.dt, parameters[4 * i : 4 * i + 4]) for i in (0, 1))
    turns = 0.5 * part.dt * (omega[1:] + omega[:-1])
    heading = np.concatenate([[0.0], np.cumsum(turns)])
    # Exact arcs: the chord has the direction of the mean heading and the length of the arc times sinc of half its turn.
    moves = 0.5 * part.dt * (v[1:] + v[:-1]) * np.sinc(turns / (2 * np.pi)) * np.exp(1j * (heading[:-1] + 0.5 * turns))
    path = np.concatenate([[0.0], np.cumsum(moves)]) + complex(*parameters[8:]) * np.exp(1j * heading)
    return heading, path[part.rows]


def _response(values: FloatArray, dt: float, parameters: FloatArray) -> FloatArray:
    from scipy import signal  # noqa: PLC0415 - loads slowly

    gain, dead_time, *lags = parameters
    grid = np.arange(len(values))
    response = gain * np.interp(grid - dead_time / dt, grid, values)
    for i, lag in enumerate(lags):
        pole = np.exp(-dt / lag)
        # Discretise the first lag exactly for a held input, and the second for linear interpolation between samples.
        mean_step = (1 - pole) * lag / dt
        taps = [1 - mean_step, mean_step - pole] if i else [0.0, 1 - pole]
        initial = signal.lfilter_zi(taps, [1.0, -pole]) * response[0]
        response = signal.lfilter(taps, [1.0, -pole], response, zi=initial)[0]
    return np.asarray(response)


def _align_windows(part: _Positions, path: AnyArray, window: float) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return measured and predicted positions (n,) relative to their window means, and the rotations (n,)."""
    index = np.unique((part.rows * part.dt) // window, return_inverse=True)[1]
    count = np.bincount(index)

    def centre(values: AnyArray) -> AnyArray:
        mean = np.bincount(index, values.real) + 1j * np.bincount(index, values.imag)
        return np.asarray((mean / count)[index])

    measured, predicted = part.measured - centre(part.measured), path - centre(path)
    return measured, predicted, np.exp(1j * np.angle(centre(np.conj(predicted) * measured)))


def _smooth_headings(part: _Positions, parameters: FloatArray) -> FloatArray:
    """Compute headings (K,) [rad] as the prediction plus a random walk that fits the positions."""
    from scipy import sparse  # noqa: PLC0415 - loads slowly
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415

    heading, path = _predict_motion(part, parameters)
    steps, count = np.diff(path), len(part.rows)
    spread = np.sqrt(np.diff(part.rows) * part.dt)
    # The third difference of white noise has 20 times the variance of the noise, in each of two axes.
    noise = 1e-4 + float(np.std(np.diff(part.measured, 3))) / np.sqrt(40.0)
    identity = sparse.identity(count, format="csr")
    change, mean = identity[1:] - identity[:-1], 0.5 * (identity[1:] + identity[:-1])
    travel_weight, turn_weight = (sparse.diags(1.0 / (size * spread)) for size in _DISTURBANCES)
    positions, walk = part.measured, np.unwrap(np.angle(_align_windows(part, path, _WINDOWS[1])[2]))
    # Gauss-Newton iterations; only the direction of the moves is nonlinear in the random walk.
    for _ in range(_ITERATIONS):
        moves = steps * np.exp(1j * (mean @ walk))
        rows = [
            [identity / noise, None, None],
            [None, identity / noise, None],
            [travel_weight @ change, None, travel_weight @ sparse.diags(moves.imag) @ mean],
            [None, travel_weight @ change, -travel_weight @ sparse.diags(moves.real) @ mean],
            [None, None, turn_weight @ change],
        ]
        position, travel = (positions - part.measured) / noise, travel_weight @ (np.diff(positions) - moves)
        errors = np.concatenate([position.real, position.imag, travel.real, travel.imag, turn_weight @ np.diff(walk)])
        jacobian = sparse.bmat(rows, format="csc")
        normal_matrix = (jacobian.T @ jacobian + 1e-9 * sparse.identity(3 * count)).tocsc()
        x, y, turn = np.split(spsolve(normal_matrix, jacobian.T @ errors), 3)
        positions, walk = positions - x - 1j * y, walk - turn
    return np.asarray(heading + np.interp(np.arange(len(heading)), part.rows, walk))
