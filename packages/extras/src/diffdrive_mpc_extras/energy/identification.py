"""Constants of the drive from a log with the battery's voltage and current and the currents of the motors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants

# Samples are combined over this time [s], with their trend: noise of a squared current would reduce its information.
_BLOCK = 0.3
_LEAST_SAMPLES = 5  # of a block: two are its mean and its trend
_LEAST_BLOCKS = 20
# The residuals of this many consecutive blocks are correlated, and count as one where that increases the uncertainty.
_ALIKE_BLOCKS = 4
# Columns with a higher correlation than this cannot be separated.
_ALIKE = 1e6
# Below this share of the greatest wheel speed in the log a block is at rest.
_RESTING = 0.02
# A constant whose deviation is a greater share of it is not told.
_TOLD = 0.5
# Number of times that the braking motors are determined again.
_PASSES = 4


class IdentifiedConstants(NamedTuple):
    """Identified constants."""

    constants: DriveConstants
    """With torque constant, resistance and idle power of the log; regeneration and efficiency are those given"""
    deviation: dict[str, float]
    """Standard deviation of each value found"""
    rms: float
    """RMS residual of the battery's power, means over 0.3 s [W]."""
    rows: int
    """Number of samples used."""


def identify_constants(records: Sequence[Record], prior: DriveConstants) -> IdentifiedConstants:
    """Identify torque constant, resistance and idle power by least squares on the power of the battery.

    The battery gives V I = sum over the motors of k (wheel speed times current) + R_e current^2, + idle power: k = K_T
    g eta turns current into torque by equations 25 and 26 of P4, so the three are linear in the logged values. Of a
    motor that brakes the part counts that `regeneration` and `driver_efficiency` leave. Where only the sides are
    logged, their motors share the current evenly.

    Two effects of a real drive are separated by their own columns, where the log has them: power that is there only
    while the wheels turn (idle power is that at rest), and the heat of currents that change faster than the log: it is
    taken to be in proportion to the residual of the logged current within 0.3 s.

    The deviations contain the residual, correlated over 1.2 s where that gives more, and half of the change by the
    ripple's column.

    Parameters
    ----------
    records
        With `battery`, `motor_current` and `wheels`; `motor_currents` and `wheel_speeds` of four motors contain more
        information.
    prior
        Model whose gears, efficiencies and number of motors are kept.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the log lacks a column, has too few samples, or its drive does not determine the three separately.
    """
    blocks = _blocks(records)
    if len(blocks.power) < _LEAST_BLOCKS:
        raise ConfigError(
            f"{blocks.samples} samples with battery, motors and wheels: give a log with "
            f"{_LEAST_BLOCKS * blocks.length} or more"
        )
    sharing = 2 * prior.motors_per_side / blocks.work.shape[1]
    slope, heating = prior.torque_per_current, prior.resistance / sharing
    fit = None
    for _ in range(_PASSES):
        weight = _weights(slope * blocks.work + heating * blocks.square, prior)
        fit = _fit(blocks, weight)
        if not (fit.values[:2] > 0).all():
            break
        slope, heating = fit.values[:2].tolist()
    assert fit is not None
    geared = prior.gear_ratio * prior.gear_efficiency
    sizes = np.array([1 / geared, sharing, 1.0])
    names = ("torque_constant", "resistance", "idle_power")
    fitted = dict(zip(names, (fit.values * sizes).tolist(), strict=True))
    deviation = dict(zip(names, (fit.deviation * sizes).tolist(), strict=True))
    if any(deviation[name] > _TOLD * abs(fitted[name]) for name in names[:2]):
        raise _untold()
    if not (fitted["torque_constant"] > 0 and fitted["resistance"] > 0):
        raise ConfigError(
            f"torque constant {fitted['torque_constant']:.3g} N m/A and resistance {fitted['resistance']:.3g} ohm "
            "follow from the log: both must be positive; check signs and units of the currents in the mapping"
        )
    fitted["idle_power"] = max(0.0, fitted["idle_power"])
    words = (
        f"identified from {blocks.samples} samples of {', '.join(record.name for record in records)}; "
        f"before: {prior.provenance}"
    )
    constants = prior.model_copy(update={**fitted, "provenance": words})
    return IdentifiedConstants(constants, deviation, fit.rms, blocks.samples)


def logged_energy(records: Sequence[Record]) -> float:
    """Integrate the energy of the battery over the records [J]; raise ConfigError without voltage and current."""
    total = 0.0
    for record in records:
        if record.battery is None:
            raise ConfigError(f"record '{record.name}': no battery; name 'battery.voltage' and 'battery.current'")
        total += float(np.nansum(record.battery.prod(axis=1)) * record.dt)
    return total


class _Blocks(NamedTuple):
    """Means of n blocks of samples, m motors or sides."""

    power: FloatArray
    """(n,) of the battery [W]"""
    work: FloatArray
    """(n, m) wheel speed times current, of mean and trend [A rad/s]"""
    square: FloatArray
    """(n, m) current squared, of mean and trend [A^2]"""
    ripple: FloatArray
    """(n, m) residual [A^2]"""
    moving: NDArray[np.bool_]
    """(n,)"""
    samples: int
    length: int
    """Samples of a block"""


class _Fit(NamedTuple):
    """Fit of k, of R_e over the motors of a current, and of the idle power."""

    values: FloatArray
    deviation: FloatArray
    rms: float


def _weights(power: FloatArray, prior: DriveConstants) -> FloatArray:
    """Compute battery power (n, m) for each watt of a motor."""
    back = prior.driver_efficiency if prior.regeneration else 0.0
    return np.where(power > 0, 1 / prior.driver_efficiency, back)


def _fit(blocks: _Blocks, weight: FloatArray) -> _Fit:
    """Fit with the columns, besides the three, that the log can distinguish."""
    wanted = [(weight * blocks.work).sum(axis=1), (weight * blocks.square).sum(axis=1), np.ones(len(blocks.power))]
    moving, ripple = blocks.moving.astype(float), (weight * blocks.ripple).sum(axis=1)
    if not _apart(wanted):
        raise _untold()
    beside: list[FloatArray] = []
    for column in (moving, ripple):
        if _apart([*wanted, *beside, column]):
            beside.append(column)
    values, variance, rms = _solved(np.stack([*wanted, *beside], axis=-1), blocks.power)
    # As if the ripple were measured whole: by how much this matters is how well it is known.
    wanted[1] = wanted[1] + ripple
    plain, _, _ = _solved(np.stack([*wanted, *beside[:1]], axis=-1), blocks.power)
    spread = variance[:3] + 0.25 * (values[:3] - plain[:3]) ** 2
    return _Fit(values[:3], np.sqrt(spread), rms)


def _apart(columns: Sequence[FloatArray]) -> bool:
    """Return True if the columns are distinguishable."""
    rows = np.stack(columns, axis=-1)
    scale = np.linalg.norm(rows, axis=0)
    return bool((scale > 0).all() and np.linalg.cond(rows / scale) < _ALIKE)


def _solved(rows: FloatArray, power: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Solve by least squares: values, their variances (sandwich estimate, by blocks and runs of them), RMS."""
    scale = np.linalg.norm(rows, axis=0)
    scaled = rows / scale
    values, *_ = np.linalg.lstsq(scaled, power, rcond=None)
    rest = power - scaled @ values
    inner = np.linalg.inv(scaled.T @ scaled)
    count, width = rows.shape
    variances = []
    for together in (1, _ALIKE_BLOCKS):
        group = np.arange(count) // together
        sums = np.zeros((int(group[-1]) + 1, width))
        np.add.at(sums, group, scaled * rest[:, None])
        free = count / max(1, count - width) * len(sums) / max(1, len(sums) - 1)
        variances.append(free * np.diag(inner @ (sums.T @ sums) @ inner))
    return values / scale, np.max(variances, axis=0) / scale**2, float(np.sqrt(np.mean(rest**2)))


def _blocks(records: Sequence[Record]) -> _Blocks:
    parts: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]] = []
    length = _LEAST_SAMPLES
    samples = 0
    for power, current, speed, dt in map(_columns, records):
        length = max(_LEAST_SAMPLES, round(_BLOCK / dt))
        count = len(power) // length
        battery_power, currents, speeds = (
            array[: count * length].reshape(count, length, -1) for array in (power[:, None], current, speed)
        )
        whole = np.all([np.isfinite(array).all(axis=(1, 2)) for array in (battery_power, currents, speeds)], axis=0)
        battery_power, currents, speeds = battery_power[whole], currents[whole], speeds[whole]
        samples += length * int(whole.sum())
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
        raise ConfigError("records: give the currents of all four motors in all of them, or of the sides in all")
    if not parts:
        return _Blocks(*(np.empty((0, 2)),) * 4, np.empty(0, dtype=bool), 0, length)
    power, work, square, ripple, fastest = (np.concatenate(column) for column in zip(*parts, strict=True))
    moving = np.asarray(fastest > _RESTING * fastest.max(initial=0.0))
    return _Blocks(power, work, square, ripple, moving, samples, length)


def _columns(record: Record) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return battery power (n,) [W], currents [A] and wheel speeds [rad/s] (n, m), and the sample time."""
    needed = (("battery", record.battery), ("motors", record.motor_current), ("encoders", record.wheels))
    absent = [key for key, value in needed if value is None]
    if record.battery is None or record.motor_current is None or record.wheels is None:
        raise ConfigError(f"record '{record.name}': no {' and no '.join(absent)}; name their columns in the mapping")
    power = record.battery.prod(axis=1)
    if record.motor_currents is not None:
        speeds = np.tile(record.wheels, 2) if record.wheel_speeds is None else record.wheel_speeds
        return power, record.motor_currents, speeds, record.dt
    return power, record.motor_current, record.wheels, record.dt


def _untold() -> ConfigError:
    return ConfigError(
        "the drive does not tell torque constant, resistance and idle power apart: let the robot stand, drive slowly "
        "under load (turns) and fast under little (straight on)"
    )
