"""Estimates of tracks, radii, delays, limits and noises for the parameters of other packages, with intervals.

One fit of a free run to encoders and gyro (`effects`) gives delay, limits and the ratio of the two yaw rates with a
joint covariance. Poses determine the radii. A quantity that the log does not determine has a reason instead of a value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.base_effects import PARTS
from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.effects.fitting import covariance, fit_effects, weight_readings
from diffdrive_mpc.models.identification.effects.free_run import Point, sensor_experiments
from diffdrive_mpc.models.identification.effects.pose_sensor import pose_sensor
from diffdrive_mpc.models.identification.effects.selection import select_effects
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.identification.fit.noise import MIN_READINGS, SECOND_DIFFERENCE, second_differences
from diffdrive_mpc.models.identification.fit.pose_calibration import (
    ConstantTrack,
    calibrate_wheels,
    rim_speeds,
    twist_with_side_slip,
)
from diffdrive_mpc.models.identification.log_data import LogData, most_informative
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import WheelGeometry, wheel_geometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import join_experiments
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.table import TextTable
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc_extras.stack.settings import stack_settings

_EFFECTS = ("clipped commands", "twist slew", "veer")
"""Effects of the base that influence the estimates."""
_EXTRA_PARAMETERS = ("damping.v", "damping.omega")
_UNITS = {"v": "m/s", "omega": "rad/s"}
DIGITS = 4
"""Significant digits of values and intervals."""


@dataclass(frozen=True)
class Quantity:
    """Quantity with its interval, or the reason why the log does not determine it.

    Attributes
    ----------
    value
        Value; None if the log does not determine it.
    interval
        95 % interval (2,); the ends are equal for a value that is stated or computed without an error.
    unit
        Unit of value and interval.
    reason
        Source of the value, or the reason why it is missing.
    """

    value: float | None
    interval: tuple[float, float]
    unit: str
    reason: str


Quantities = Mapping[str, Quantity]
"""Quantities by the names listed in `estimate_stack`."""


def estimate_stack(
    data: LogData, limits: Mapping[str, float] | None = None, base: IdentifiedBase | None = None
) -> dict[str, Quantity]:
    """Estimate the quantities of a robot that are parameters of ros2_control, Nav2 and robot_localization.

    Names: wheel_separation, wheel_radius [m]; separation_multiplier, left_radius_multiplier, right_radius_multiplier
    [-]; delay.v, delay.omega [s]; max.v, max.omega, rate.v, rate.omega, driven.v [SI units]; look_ahead_time [s],
    look_ahead, min_look_ahead, max_look_ahead [m]; variance.v, variance.omega, variance.gyro [(SI units)^2];
    controller_frequency [Hz], for which the look-ahead is valid.

    Parameters
    ----------
    data
        Data of the log; only the training records are used.
    limits
        Clipping levels of a model of the log by channel [m/s, rad/s]: initial values of the limits.
    base
        Identified model with all effects of the base; its effects replace the search for effects.

    Raises
    ------
    ValueError
        If a reading never changes, or the records are too short.
    """
    settings = stack_settings()
    data = replace(data, train=tuple(most_informative(data.train, identification_settings().max_rows["effects"])))
    geometry = wheel_geometry(data.train)
    max_command = np.abs(np.concatenate([record.command for record in data.train])).max(axis=0)
    levels = dict(zip(CHANNELS, (settings.first_limit * max_command).tolist(), strict=True)) | dict(limits or {})
    track = geometry.track if geometry else None
    experiments = join_experiments(sensor_experiments(data.train, data.yaw))
    if base is None:
        selection = select_effects(experiments, track, limits=levels, names=_EFFECTS, extra=_EXTRA_PARAMETERS)
        fit, weights = selection.fit, selection.data
    else:
        weights = weight_readings(experiments, base.point)
        fit = fit_effects(base.point, _free_parameters(base.point), weights, near=True)
    values = np.array([fit.point[name] for name in fit.free])
    estimate = ParameterEstimate(fit.free, values, covariance(fit, weights))
    radii = _calibrate_radii(data, geometry, fit.point)
    wheels = _wheel_quantities(data.stated_track, geometry, estimate, radii)
    multipliers = [wheels[f"{name}_multiplier"] for name in ("left_radius", "separation")]
    quantities = {
        **wheels,
        **_delay_quantities(fit.point, estimate, data.train[0].dt),
        **_limit_quantities(max_command, fit.point, estimate, [part.value is not None for part in multipliers]),
        **_variance_quantities(data),
    }
    return quantities | _look_ahead_quantities(quantities)


def _free_parameters(point: Point) -> list[str]:
    """Return the names of parameters that are not at a bound, except the track of the log."""
    bounds = effect_settings().parameters
    names = [name for name in point if name in bounds and name != "encoders.track"]
    return [name for name in names if point[name] not in bounds[name][:2]]


def _estimated_quantity(estimate: ParameterEstimate, unit: str, reason: str) -> Quantity:
    """Return the first parameter of an estimate with its 95 % interval; a missing quantity if they are not finite."""
    value, half_width = float(estimate.values[0]), 1.96 * float(estimate.standard_deviation[0])
    if not math.isfinite(value):
        return _missing_quantity(
            unit, "the estimate is not a finite number: drive steps of both signs in v and in omega"
        )
    if not math.isfinite(half_width):
        return _missing_quantity(unit, "its interval is not finite: the log does not separate it from other parameters")
    return Quantity(value, (value - half_width, value + half_width), unit, reason)


def _stated_quantity(value: float, unit: str, reason: str) -> Quantity:
    return Quantity(value, (value, value), unit, reason)


def _missing_quantity(unit: str, reason: str) -> Quantity:
    return Quantity(None, (math.nan, math.nan), unit, reason)


def _calibrate_radii(data: LogData, geometry: WheelGeometry | None, point: Point) -> ParameterEstimate | str:
    """Return left_radius, right_radius and track [m] from poses, or the reason why the log does not determine them."""
    records = [record for record in data.train if record.pose is not None and record.wheels is not None]
    if geometry is None:
        return "the log has no wheel speeds: log joint states with the velocity of each wheel"
    if not records:
        return "the log has no external pose: a different radius has the same effect as a different speed"
    sensor = pose_sensor(records, point) if data.yaw == "gyro" else None
    lag = sensor.value("pose.delay") - point["encoders.delay"] - point.get("encoders.lag", 0.0) if sensor else 0.0
    try:
        estimate = calibrate_wheels(
            [_delayed_wheels(record, lag) for record in records], TwoRadii(*geometry)
        ).parameters
    except ValueError as error:
        return str(error)
    half_interval = 1.96 * float(np.max(estimate.standard_deviation[:2] / estimate.values[:2]))
    if not math.isfinite(half_interval):
        return "the poses of this log do not determine the radii: their interval is not finite"
    if half_interval > stack_settings().max_radius_half_interval:
        return f"the poses determine the radii only to {100 * half_interval:.2g} %: log better poses or a longer drive"
    return estimate


@dataclass(frozen=True)
class TwoRadii(ConstantTrack):
    """Slip law with a constant track and a separate radius for each side.

    Coefficients: left_radius, right_radius [m], track [m], side_slip [s].
    """

    names: tuple[str, ...] = ("left_radius", "right_radius", "track", "side_slip")

    @property
    def start(self) -> FloatArray:
        """Initial values (4,) of the coefficients."""
        return np.array([self.wheel_radius, self.wheel_radius, self.track, 0.0])

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """Return the twist (..., 3) as in `ConstantTrack`."""
        *radii, track, side_slip = coefficients
        v, difference = rim_speeds(1.0, wheels * np.array(radii))
        omega = difference / track
        return twist_with_side_slip(v, omega, side_slip)


def _delayed_wheels(record: Record, lag: float) -> Record:
    """Delay the wheel speeds of a record by `lag` [s], with interpolation: rounding to samples biases the radius."""
    assert record.wheels is not None
    is_known = np.isfinite(record.wheels).all(axis=1)
    columns = [np.interp(record.time - lag, record.time[is_known], column[is_known]) for column in record.wheels.T]
    return replace(record, wheels=np.column_stack(columns))


def _wheel_quantities(
    stated: float | None,
    geometry: WheelGeometry | None,
    estimate: ParameterEstimate,
    radii: ParameterEstimate | str,
) -> dict[str, Quantity]:
    """Return separation, radius and multipliers; the three multipliers come from the same source."""
    separation = stated or (geometry.track if geometry else None)
    source = "stated in the mapping" if stated else "used in the computation of the log's omega"
    result = {
        "wheel_separation": _stated_quantity(separation, "m", source)
        if separation
        else _missing_quantity("m", "neither log nor mapping states a track: use the robot description"),
        "wheel_radius": _stated_quantity(geometry.radius, "m", "used in the computation of the log's v")
        if geometry
        else _missing_quantity("m", "the log has no wheel speeds: use the robot description"),
    }
    if not isinstance(radii, str) and geometry and separation:
        radius_reason = f"radius from wheel speeds and poses, divided by {geometry.radius:.4g} m"
        for side in ("left", "right"):
            multiplier = radii.part([f"{side}_radius"]).derived(["radius"], lambda row: row / geometry.radius)
            result[f"{side}_radius_multiplier"] = _estimated_quantity(multiplier, "", radius_reason)
        track = radii.part(["track"]).derived(["track"], lambda row: row / separation)
        reason = f"effective track from poses, divided by {separation:.4g} m; valid with the radii of this file"
        result["separation_multiplier"] = _checked_width(_estimated_quantity(track, "", reason))
        return result
    reason = radii if isinstance(radii, str) else "neither log nor mapping states a track"
    result |= dict.fromkeys(("left_radius_multiplier", "right_radius_multiplier"), _missing_quantity("", reason))
    if "encoders.yaw_ratio" not in estimate.names:
        reason = "the log has neither a gyro nor a pose: it does not determine the yaw rate of the body"
        return result | {"separation_multiplier": _missing_quantity("", reason)}
    ratio = estimate.part(["encoders.yaw_ratio"])
    if geometry is None or separation is None:
        factor = _estimated_quantity(ratio, "", "")
        if factor.value is None:
            return result | {"separation_multiplier": factor}
        reason = (
            "the log has no wheel speeds: multiply the separation multiplier of the odometry in this log "
            f"by {factor.value:.4g} [{factor.interval[0]:.4g}, {factor.interval[1]:.4g}]"
        )
        return result | {"separation_multiplier": _missing_quantity("", reason)}
    track = ratio.derived(["track"], lambda row: row * geometry.track / separation)
    reason = f"ratio of the yaw rates of wheels and gyro, for a separation of {separation:.4g} m"
    return result | {"separation_multiplier": _checked_width(_estimated_quantity(track, "", reason))}


def _checked_width(quantity: Quantity) -> Quantity:
    """Return the quantity, or a missing quantity if its interval is too wide to be useful."""
    low, high, max_ratio = *quantity.interval, stack_settings().max_half_interval
    if quantity.value is None or 0.5 * (high - low) <= max_ratio * abs(quantity.value):
        return quantity
    return _missing_quantity(
        quantity.unit, f"the log gives only {low:.3g} to {high:.3g} {quantity.unit}: drive with larger steps"
    )


def _delay_quantities(point: Point, estimate: ParameterEstimate, dt: float) -> dict[str, Quantity]:
    """Return the delay of each channel [s]: dead time plus both lags."""
    # The model evaluates a ramp at the end of each part of a sample, which adds half a part to the delay.
    excess = 0.5 * dt / PARTS if "slew.v" in point else 0.0
    result = {}
    for channel in CHANNELS:
        names = [f"{kind}.{channel}" for kind in ("dead_time", "lag")] + [f"damping.{channel}"]

        def total_delay(row: FloatArray, names: Sequence[str] = names) -> FloatArray:
            values = {**point, **dict(zip(estimate.names, row.tolist(), strict=True))}
            dead_time, lag, damping = (values.get(name, 1.0) for name in names)
            return np.array([dead_time + 2.0 * lag * damping - excess])

        dead_time = point[names[0]]
        delay = _estimated_quantity(
            estimate.derived(["delay"], total_delay), "s", f"dead time of {dead_time:.3g} s and lag of {channel}"
        )
        if delay.value is not None:
            # Slow disturbances cause errors that the residuals do not show.
            half_width = 0.5 * stack_settings().delay_widening * (delay.interval[1] - delay.interval[0])
            delay = replace(delay, interval=(max(0.0, delay.value - half_width), delay.value + half_width))
        result[f"delay.{channel}"] = delay
    return result


def _limit_quantities(
    max_command: FloatArray, point: Point, estimate: ParameterEstimate, corrected: Sequence[bool]
) -> dict[str, Quantity]:
    """Return the speeds and accelerations at which the robot saturates.

    Other packages limit commands. In a channel with a multiplier (`corrected`, (2,)) the command is the motion of the
    body, which is the command of the log times the gain. In other channels it is the command of the log. A limit counts
    as not reached if its interval includes `max_command` (2,), the maximum command of the log.
    """
    result = {}
    for maximum, channel, is_corrected in zip(max_command.tolist(), CHANNELS, corrected, strict=True):
        unit, gain = _UNITS[channel], point[f"gain.{channel}"]
        name = "separation multiplier" if channel == "omega" else "radius multipliers"
        part, condition = ["command"], "; for the multipliers of the log"
        if is_corrected:
            part, condition = ["body"], f", times its gain; only with the {name} of ros2_control.yaml"
        level, rate = (_limit_in_body(estimate, kind, channel) for kind in ("limit", "slew"))
        # `_estimated_quantity` handles intervals that are not finite.
        is_reached = level is not None and not level.values[1] + 1.96 * level.deviation("command") >= maximum
        result[f"max.{channel}"] = (
            _checked_width(_estimated_quantity(level.part(part), unit, f"command at which the robot clips{condition}"))
            if level is not None and is_reached
            else _missing_quantity(unit, f"not reached in this log, which drives up to {gain * maximum:.3g} {unit}")
        )
        result[f"rate.{channel}"] = (
            _checked_width(
                _estimated_quantity(rate.part(part), f"{unit}^2", f"maximum slope of the robot's response{condition}")
            )
            if rate is not None
            else _missing_quantity(f"{unit}^2", "no command of this log exceeds the maximum slope of the robot")
        )
        max_speed = gain * min(maximum, float(level.values[1]) if level is not None and is_reached else maximum)
        result[f"driven.{channel}"] = _stated_quantity(
            max_speed, unit, "maximum command that the robot follows, times the gain"
        )
    return result


def _limit_in_body(estimate: ParameterEstimate, kind: str, channel: str) -> ParameterEstimate | None:
    """Return a limit of the motion ("body") and of the command; None if the model has no such limit."""
    names = [f"{kind}.{channel}", f"gain.{channel}"]
    if names[0] not in estimate.names:
        return None
    return estimate.part(names).derived(["body", "command"], lambda pair: np.array([pair[0] * pair[1], pair[0]]))


def _variance_quantities(data: LogData) -> dict[str, Quantity]:
    """Return the noise variances of encoders and gyro, from differences of neighbouring readings."""
    sources = {"v": ("twist", 0), "omega": ("twist", 1), "gyro": ("yaw_rate", 0)}
    result = {}
    for name, (signal, column) in sources.items():
        unit = "(m/s)^2" if name == "v" else "(rad/s)^2"
        blocks = _scatter_by_block(data.train, signal, column)
        if len(blocks) < stack_settings().min_blocks:
            result[f"variance.{name}"] = _missing_quantity(
                unit, f"the log has too few readings of {name} to estimate its noise"
            )
            continue
        mean, error = float(blocks.mean()), float(blocks.std(ddof=1) / math.sqrt(len(blocks)))
        if not math.isfinite(mean + error):
            result[f"variance.{name}"] = _missing_quantity(unit, f"the scatter of the readings of {name} is not finite")
            continue
        reason = f"scatter of neighbouring readings in {len(blocks)} blocks; without slip"
        result[f"variance.{name}"] = Quantity(mean, (max(0.0, mean - 2 * error), mean + 2 * error), unit, reason)
    return result


def _scatter_by_block(records: Sequence[Record], signal: str, column: int) -> FloatArray:
    """Return the noise variance (B,) of one column of a signal in each block of the length in the settings.

    The variance follows from second differences; blocks with fewer than `MIN_READINGS` differences are omitted.
    """
    variances = []
    for record in records:
        span = max(1, round(identification_settings().block_time / record.dt))
        for first in range(0, len(record.command), span):
            block = record.part(first, min(first + span, len(record.command)))
            differences = second_differences(block, signal, [column])
            if differences.size >= MIN_READINGS:
                variances.append(float(np.mean(differences**2)) / SECOND_DIFFERENCE**2)
    return np.array(variances)


def look_ahead_factor(phase_margin: float) -> float:
    """Return the ratio of pure pursuit's minimum look-ahead time to the robot's delay [-], for a phase margin [rad].

    On a straight path pure pursuit steers with the curvature -2 (y + L psi) / L^2. With y' = v psi, psi' = v curvature,
    p = s L / v and theta = delay v / L its open loop is 2 (p + 1) exp(-theta p) / p^2. Its gain is 1 at w^2 = 2 +
    sqrt(8), and its phase there is -pi + atan(w) - w theta. Therefore L / v = delay w / (atan(w) - margin). Source of
    the method: Ollero, Heredia, "Stability analysis of mobile robot path tracking", IROS 1995.
    """
    crossover = math.sqrt(2.0 + math.sqrt(8.0))
    return crossover / (math.atan(crossover) - phase_margin)


def _look_ahead_quantities(quantities: Quantities) -> dict[str, Quantity]:
    """Return the look-ahead of regulated pure pursuit from the delay of omega and half a period of the controller."""
    delay, settings = quantities["delay.omega"], stack_settings()
    frequency = _stated_quantity(
        settings.controller_frequency, "Hz", "default of Nav2, for which the look-ahead is valid"
    )
    if delay.value is None:
        missing_reason = f"the delay of omega is not known: {delay.reason}"
        units = {"look_ahead_time": "s", "look_ahead": "m", "min_look_ahead": "m", "max_look_ahead": "m"}
        return {
            **{name: _missing_quantity(unit, missing_reason) for name, unit in units.items()},
            "controller_frequency": frequency,
        }
    factor, half_period = look_ahead_factor(math.radians(settings.phase_margin)), 0.5 / settings.controller_frequency
    reason = (
        f"{factor:.3g} times the sum of the delay of omega and half a period at {settings.controller_frequency:g} Hz: "
        f"phase margin of {settings.phase_margin:g} degrees on a straight path"
    )

    def look_ahead(speed: float, unit: str, reason: str) -> Quantity:
        low, value, high = (
            speed * factor * (end + half_period) for end in (delay.interval[0], delay.value or 0.0, delay.interval[1])
        )
        return Quantity(value, (low, high), unit, reason)

    max_speed = quantities["driven.v"].value or 0.0
    min_speed = min(settings.slow_speed, max_speed)
    max_reason = f"look-ahead time at {max_speed:.3g} m/s, the maximum speed in this log"
    return {
        "look_ahead_time": look_ahead(1.0, "s", reason),
        "look_ahead": look_ahead(max_speed, "m", max_reason),
        "min_look_ahead": look_ahead(min_speed, "m", f"look-ahead time at {min_speed:.3g} m/s"),
        "max_look_ahead": look_ahead(max_speed, "m", max_reason),
        "controller_frequency": frequency,
    }


def interval_text(quantity: Quantity) -> str:
    """Format the interval with its unit, followed by a comma and a blank."""
    low, high = quantity.interval
    unit = f" {quantity.unit}" if quantity.unit else ""
    return f"[{low:.{DIGITS}g}, {high:.{DIGITS}g}]{unit}, " if low < high else f"{quantity.unit}, "


def quantity_table(quantities: Quantities) -> TextTable:
    """Return a table with a row for each quantity, including the missing ones."""
    rows = [
        (
            name,
            "-" if part.value is None else f"{part.value:.{DIGITS}g}",
            "not known" if part.value is None else interval_text(part).rstrip(", "),
            part.reason,
        )
        for name, part in quantities.items()
    ]
    note = "95 % intervals. The parameter files show which parameter each quantity sets."
    return TextTable(
        "Quantities for other packages",
        ("quantity", "value", "interval", "reason"),
        tuple(rows),
        text_columns=4,
        note=note,
    )
