"""Drive constants from a log of battery voltage, battery current and motor currents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants

# Duration of a block [s], which is reduced to mean and trend: squares of single noisy currents are less informative.
_BLOCK_DURATION = 0.3
_MIN_BLOCK_SAMPLES = 5  # mean and trend take two degrees of freedom
_MIN_BLOCKS = 20
# Number of consecutive blocks with correlated residuals. They count as one block if that increases the uncertainty.
_CORRELATED_BLOCKS = 4
# Maximum condition number of columns that a fit can separate.
_MAX_CONDITION = 1e6
# A block is at rest below this fraction of the maximum wheel speed in the log.
_REST_FRACTION = 0.02
# Maximum relative standard deviation of an identified constant.
_MAX_RELATIVE_DEVIATION = 0.5
# Number of fits; each determines the braking motors from the previous fit.
_PASSES = 4


class IdentifiedConstants(NamedTuple):
    """Result of an identification."""

    constants: DriveConstants
    """Identified torque constant, resistance and idle power; the other values are those of the prior."""
    deviation: dict[str, float]
    """Standard deviation of each identified constant, by name."""
    rms: float
    """RMS residual of the battery power, averaged over blocks of 0.3 s [W]."""
    rows: int
    """Number of samples used."""


def identify_constants(records: Sequence[Record], prior: DriveConstants) -> IdentifiedConstants:
    """Identify torque constant, resistance and idle power by least squares on the battery power.

    The battery power is V I = idle power + the sum over the motors of k (wheel speed times current) + R_e current^2.
    The factor k = K_T g eta converts current to torque (equations 25 and 26 of P4), so the three constants enter
    linearly. The power of a braking motor is scaled by `driver_efficiency`, or is zero without `regeneration`. If the
    log has the currents of the sides only, the motors of a side share the current evenly.

    Additional columns separate two effects of a real drive if the log determines them. The first is the additional
    power while the wheels turn; the idle power is the power at rest. The second is the heat of currents that change
    faster than the sample time. This heat is assumed proportional to the squared residual of the logged current in a
    block of 0.3 s.

    The deviations contain the residual, with correlation over 1.2 s if this increases them, and half of the change that
    the ripple column causes.

    Parameters
    ----------
    records
        Records with `battery`, `motor_current` and `wheels`; `motor_currents` and `wheel_speeds` of four motors contain
        more information.
    prior
        Drive constants; gears, efficiencies and number of motors are kept.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the log lacks a column, has too few samples, or does not determine the three constants separately.
    """
    blocks = _blocks(records)
    if len(blocks.power) < _MIN_BLOCKS:
        raise ConfigError(
            f"{blocks.samples} samples with battery, motors and wheels: give a log with at least "
            f"{_MIN_BLOCKS * blocks.length}"
        )
    motors_per_column = 2 * prior.motors_per_side / blocks.work.shape[1]
    slope, heating = prior.torque_per_current, prior.resistance / motors_per_column
    fit = None
    for _ in range(_PASSES):
        weight = _weights(slope * blocks.work + heating * blocks.square, prior)
        fit = _fit(blocks, weight)
        if not (fit.values[:2] > 0).all():
            break
        slope, heating = fit.values[:2].tolist()
    assert fit is not None
    gearing = prior.gear_ratio * prior.gear_efficiency
    scale = np.array([1 / gearing, motors_per_column, 1.0])
    names = ("torque_constant", "resistance", "idle_power")
    fitted = dict(zip(names, (fit.values * scale).tolist(), strict=True))
    deviation = dict(zip(names, (fit.deviation * scale).tolist(), strict=True))
    if any(deviation[name] > _MAX_RELATIVE_DEVIATION * abs(fitted[name]) for name in names[:2]):
        raise _undetermined_error()
    if not (fitted["torque_constant"] > 0 and fitted["resistance"] > 0):
        raise ConfigError(
            f"the log gives torque constant {fitted['torque_constant']:.3g} N m/A and resistance "
            f"{fitted['resistance']:.3g} ohm: both must be positive; check signs and units of the mapped currents"
        )
    fitted["idle_power"] = max(0.0, fitted["idle_power"])
    provenance = (
        f"identified from {blocks.samples} samples of {', '.join(record.name for record in records)}; "
        f"prior: {prior.provenance}"
    )
    constants = prior.model_copy(update={**fitted, "provenance": provenance})
    return IdentifiedConstants(constants, deviation, fit.rms, blocks.samples)


def logged_energy(records: Sequence[Record]) -> float:
    """Integrate the battery power over the records [J]; raise ConfigError if voltage and current are missing."""
    total = 0.0
    for record in records:
        if record.battery is None:
            raise ConfigError(f"record '{record.name}': no battery; name 'battery.voltage' and 'battery.current'")
        total += float(np.nansum(record.battery.prod(axis=1)) * record.dt)
    return total


class _Blocks(NamedTuple):
    """Averages of n blocks of samples for m motors or sides."""

    power: FloatArray
    """(n,) battery power [W]."""
    work: FloatArray
    """(n, m) wheel speed times current, from mean and trend [A rad/s]."""
    square: FloatArray
    """(n, m) squared current, from mean and trend [A^2]."""
    ripple: FloatArray
    """(n, m) mean square of the current minus `square` [A^2]."""
    is_moving: NDArray[np.bool_]
    """(n,) True if a wheel turns."""
    samples: int
    """Number of samples in all blocks."""
    length: int
    """Number of samples of a block."""


class _Fit(NamedTuple):
    """Fit of k [N m/A], of the resistance of a logged current [ohm] and of the idle power [W]."""

    values: FloatArray
    deviation: FloatArray
    rms: float


def _weights(power: FloatArray, prior: DriveConstants) -> FloatArray:
    """Return battery power over motor power, for motor powers (n, m) [W]."""
    recovery = prior.driver_efficiency if prior.regeneration else 0.0
    return np.where(power > 0, 1 / prior.driver_efficiency, recovery)


def _fit(blocks: _Blocks, weight: FloatArray) -> _Fit:
    """Fit the three constants, with each additional column that the log can separate."""
    columns = [(weight * blocks.work).sum(axis=1), (weight * blocks.square).sum(axis=1), np.ones(len(blocks.power))]
    is_moving, ripple = blocks.is_moving.astype(float), (weight * blocks.ripple).sum(axis=1)
    if not _are_separable(columns):
        raise _undetermined_error()
    additional: list[FloatArray] = []
    for column in (is_moving, ripple):
        if _are_separable([*columns, *additional, column]):
            additional.append(column)
    values, variance, rms = _solve(np.stack([*columns, *additional], axis=-1), blocks.power)
    # Fit again with the ripple as measured: the difference indicates the uncertainty of its contribution.
    columns[1] = columns[1] + ripple
    alternative, _, _ = _solve(np.stack([*columns, *additional[:1]], axis=-1), blocks.power)
    total_variance = variance[:3] + 0.25 * (values[:3] - alternative[:3]) ** 2
    return _Fit(values[:3], np.sqrt(total_variance), rms)


def _are_separable(columns: Sequence[FloatArray]) -> bool:
    """Return True if a fit can separate the columns."""
    rows = np.stack(columns, axis=-1)
    scale = np.linalg.norm(rows, axis=0)
    return bool((scale > 0).all() and np.linalg.cond(rows / scale) < _MAX_CONDITION)


def _solve(rows: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Solve the least-squares problem; return the values, their variances and the RMS residual.

    The variances are the larger of two sandwich estimates: single blocks, and groups of correlated blocks.
    """
    scale = np.linalg.norm(rows, axis=0)
    scaled = rows / scale
    values, *_ = np.linalg.lstsq(scaled, power, rcond=None)
    residual = power - scaled @ values
    inverse = np.linalg.inv(scaled.T @ scaled)
    count, width = rows.shape
    variances = []
    for group_size in (1, _CORRELATED_BLOCKS):
        group = np.arange(count) // group_size
        sums = np.zeros((int(group[-1]) + 1, width))
        np.add.at(sums, group, scaled * residual[:, None])
        correction = count / max(1, count - width) * len(sums) / max(1, len(sums) - 1)
        variances.append(correction * np.diag(inverse @ (sums.T @ sums) @ inverse))
    return values / scale, np.max(variances, axis=0) / scale**2, float(np.sqrt(np.mean(residual**2)))


def _blocks(records: Sequence[Record]) -> _Blocks:
    parts: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]] = []
    length = _MIN_BLOCK_SAMPLES
    samples = 0
    for power, current, speed, dt in map(_columns, records):
        length = max(_MIN_BLOCK_SAMPLES, round(_BLOCK_DURATION / dt))
        count = len(power) // length
        battery_power, currents, speeds = (
            array[: count * length].reshape(count, length, -1) for array in (power[:, None], current, speed)
        )
        is_finite = np.all([np.isfinite(array).all(axis=(1, 2)) for array in (battery_power, currents, speeds)], axis=0)
        battery_power, currents, speeds = battery_power[is_finite], currents[is_finite], speeds[is_finite]
        samples += length * int(is_finite.sum())
        steps = np.arange(length) - 0.5 * (length - 1)
        steps /= np.sqrt(np.mean(steps**2))
        means = [array.mean(axis=1) for array in (currents, speeds)]
        trends = [np.einsum("nbm,b->nm", array, steps) / length for array in (currents, speeds)]
        square = means[0] ** 2 + trends[0] ** 2
        parts.append(
            (
                battery_power.mean(axis=(1, 2)),
                means[0] * means[1] + trends[0] * trends[1],
                square,
                np.maximum((currents**2).mean(axis=1) - square, 0.0),
                np.abs(means[1]).max(axis=1, initial=0.0),
            )
        )
    if len({part[1].shape[1] for part in parts}) > 1:
        raise ConfigError("records: give the currents of all four motors in each record, or of both sides in each")
    if not parts:
        return _Blocks(*(np.empty((0, 2)),) * 4, np.empty(0, dtype=bool), 0, length)
    power, work, square, ripple, speed = (np.concatenate(column) for column in zip(*parts, strict=True))
    is_moving = np.asarray(speed > _REST_FRACTION * speed.max(initial=0.0))
    return _Blocks(power, work, square, ripple, is_moving, samples, length)


def _columns(record: Record) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return battery power (n,) [W], currents [A] and wheel speeds [rad/s] (n, m), and the sample time."""
    required = (("battery", record.battery), ("motors", record.motor_current), ("encoders", record.wheels))
    missing = [key for key, value in required if value is None]
    if record.battery is None or record.motor_current is None or record.wheels is None:
        raise ConfigError(f"record '{record.name}': no {' and no '.join(missing)}; name their columns in the mapping")
    power = record.battery.prod(axis=1)
    if record.motor_currents is not None:
        speeds = np.tile(record.wheels, 2) if record.wheel_speeds is None else record.wheel_speeds
        return power, record.motor_currents, speeds, record.dt
    return power, record.motor_current, record.wheels, record.dt


def _undetermined_error() -> ConfigError:
    return ConfigError(
        "the log does not separate torque constant, resistance and idle power: record the robot at rest, slow with a "
        "high load (turns) and fast with a low load (straight ahead)"
    )
