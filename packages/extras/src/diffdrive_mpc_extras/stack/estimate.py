"""Tracks, radii, delays, limits and noises that other packages take as parameters, from a log, with intervals.

One free run from the commands explains encoders and gyro at once (`effects`), so that delay, limits and the ratio of
the two yaw rates come with one covariance. Poses determine the radii. A number that a log does not determine has a
reason and no value.
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
    at_the_rim,
    calibrate_wheels,
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

_TRIED = ("clipped commands", "twist slew", "veer")
"""Effects of the base that change the estimates."""
_ALSO = ("damping.v", "damping.omega")
_UNITS = {"v": "m/s", "omega": "rad/s"}
DIGITS = 4
"""Significant digits of values and intervals."""


@dataclass(frozen=True)
class Quantity:
    """A number that a log determines, or the reason for its absence.

    Attributes
    ----------
    value
        None where the log does not determine it.
    interval
        (2,) of 95 %; equal ends where the value is stated, or follows without an error.
    unit
        Unit of both.
    reason
        Source of the value, or the reason for its absence.
    """

    value: float | None
    interval: tuple[float, float]
    unit: str
    reason: str


Quantities = Mapping[str, Quantity]
"""By the names that `estimate_stack` lists."""


def estimate_stack(
    data: LogData, limits: Mapping[str, float] | None = None, base: IdentifiedBase | None = None
) -> dict[str, Quantity]:
    """Estimate the values of a robot that ros2_control, Nav2 and robot_localization need.

    Names: wheel_separation, wheel_radius [m]; separation_multiplier, left_radius_multiplier, right_radius_multiplier
    [-]; delay.v, delay.omega [s]; max.v, max.omega, rate.v, rate.omega, driven.v [SI units]; look_ahead_time [s],
    look_ahead, min_look_ahead, max_look_ahead [m]; variance.v, variance.omega, variance.gyro [(SI units)^2];
    controller_frequency [Hz], for which the look-ahead holds.

    Parameters
    ----------
    data
        The records; those to identify from are used.
    limits
        Levels at which a model of the log clips its commands, by channel: where the search for limits begins.
    base
        A model with all effects of the base, where it was identified: its effects are taken in place of a search.

    Raises
    ------
    ValueError
        If a reading never changes, or the records are too short.
    """
    settings = stack_settings()
    data = replace(data, train=tuple(most_informative(data.train, identification_settings().most_rows["effects"])))
    geometry = wheel_geometry(data.train)
    largest = np.abs(np.concatenate([record.command for record in data.train])).max(axis=0)
    levels = dict(zip(CHANNELS, (settings.first_limit * largest).tolist(), strict=True)) | dict(limits or {})
    track = geometry.track if geometry else None
    experiments = join_experiments(sensor_experiments(data.train, data.yaw))
    if base is None:
        selection = select_effects(experiments, track, limits=levels, only=_TRIED, also=_ALSO)
        fit, weights = selection.fit, selection.data
    else:
        weights = weight_readings(experiments, base.point)
        fit = fit_effects(base.point, _free(base.point), weights, near=True)
    values = np.array([fit.point[name] for name in fit.free])
    estimate = ParameterEstimate(fit.free, values, covariance(fit, weights))
    calibrated = _calibrated(data, geometry, fit.point)
    wheels = _wheels(data.stated_track, geometry, estimate, calibrated)
    multipliers = [wheels[f"{name}_multiplier"] for name in ("left_radius", "separation")]
    quantities = {
        **wheels,
        **_delays(fit.point, estimate, data.train[0].dt),
        **_limits(largest, fit.point, estimate, [part.value is not None for part in multipliers]),
        **_variances(data),
    }
    return quantities | _look_ahead(quantities)


def _free(point: Point) -> list[str]:
    """Return the parameters of a model with effects that are no bound of the search and not the log's own track."""
    bounds = effect_settings().parameters
    names = [name for name in point if name in bounds and name != "encoders.track"]
    return [name for name in names if point[name] not in bounds[name][:2]]


def _estimated(estimate: ParameterEstimate, unit: str, reason: str) -> Quantity:
    """Return the first parameter of an estimate with its interval of 95 %; none if one is not finite."""
    value, half = float(estimate.values[0]), 1.96 * float(estimate.standard_deviation[0])
    if not math.isfinite(value):
        return _missing(unit, "the estimate is not a finite number: drive steps of both signs in v and in omega")
    if not math.isfinite(half):
        return _missing(unit, "its interval is not finite: the log does not tell it apart from other parameters")
    return Quantity(value, (value - half, value + half), unit, reason)


def _stated(value: float, unit: str, reason: str) -> Quantity:
    return Quantity(value, (value, value), unit, reason)


def _missing(unit: str, reason: str) -> Quantity:
    return Quantity(None, (math.nan, math.nan), unit, reason)


def _calibrated(data: LogData, geometry: WheelGeometry | None, point: Point) -> ParameterEstimate | str:
    """Return left_radius, right_radius and track [m] from poses, or the reason why the log does not determine them."""
    records = [record for record in data.train if record.pose is not None and record.wheels is not None]
    if geometry is None:
        return "the log has no wheel speeds: log joint states with the velocity of each wheel"
    if not records:
        return "the log has no pose from outside: wheels of another radius look like another speed"
    sensor = pose_sensor(records, point) if data.yaw == "gyro" else None
    lag = sensor.value("pose.delay") - point["encoders.delay"] - point.get("encoders.lag", 0.0) if sensor else 0.0
    try:
        estimate = calibrate_wheels([_later(record, lag) for record in records], TwoRadii(*geometry)).parameters
    except ValueError as error:
        return str(error)
    unsure = 1.96 * float(np.max(estimate.standard_deviation[:2] / estimate.values[:2]))
    if not math.isfinite(unsure):
        return "the poses of this log tell no radii: their interval is not finite"
    if unsure > stack_settings().max_radius_half_interval:
        return f"the poses of this log tell radii only to {100 * unsure:.2g} %: better poses, or a longer log"
    return estimate


@dataclass(frozen=True)
class TwoRadii(ConstantTrack):
    """Constant track with one radius for each side.

    Coefficients: left_radius, right_radius [m], track [m], side_slip [s].
    """

    names: tuple[str, ...] = ("left_radius", "right_radius", "track", "side_slip")

    @property
    def start(self) -> FloatArray:
        """(4,)."""
        return np.array([self.wheel_radius, self.wheel_radius, self.track, 0.0])

    def twist(self, coefficients: FloatArray, wheels: FloatArray) -> FloatArray:
        """Return (..., 3); see `SlipLaw`."""
        *radii, track, side_slip = coefficients
        v, difference = at_the_rim(1.0, wheels * np.array(radii))
        omega = difference / track
        return twist_with_side_slip(v, omega, side_slip)


def _later(record: Record, lag: float) -> Record:
    """Return the record with wheel speeds as old as its poses, to parts of a sample: rounding looks like a radius."""
    assert record.wheels is not None
    known = np.isfinite(record.wheels).all(axis=1)
    columns = [np.interp(record.time - lag, record.time[known], column[known]) for column in record.wheels.T]
    return replace(record, wheels=np.column_stack(columns))


def _wheels(
    stated: float | None,
    geometry: WheelGeometry | None,
    estimate: ParameterEstimate,
    calibrated: ParameterEstimate | str,
) -> dict[str, Quantity]:
    """Return separation, radius and their multipliers; all three of one source, as they belong together."""
    separation = stated or (geometry.track if geometry else None)
    source = "as the mapping states it" if stated else "by which the log's omega was computed"
    result = {
        "wheel_separation": _stated(separation, "m", source)
        if separation
        else _missing("m", "neither log nor mapping states a track: take the robot's description"),
        "wheel_radius": _stated(geometry.radius, "m", "by which the log's v was computed")
        if geometry
        else _missing("m", "the log has no wheel speeds: take the robot's description"),
    }
    if not isinstance(calibrated, str) and geometry and separation:
        of_radius = f"wheels against the pose, over the radius of {geometry.radius:.4g} m"
        for side in ("left", "right"):
            part = calibrated.part([f"{side}_radius"]).derived(["radius"], lambda row: row / geometry.radius)
            result[f"{side}_radius_multiplier"] = _estimated(part, "", of_radius)
        wide = calibrated.part(["track"]).derived(["track"], lambda row: row / separation)
        reason = f"effective track by the pose over the separation of {separation:.4g} m, with the radii of this file"
        result["separation_multiplier"] = _sure(_estimated(wide, "", reason))
        return result
    words = calibrated if isinstance(calibrated, str) else "neither log nor mapping states a track"
    result |= dict.fromkeys(("left_radius_multiplier", "right_radius_multiplier"), _missing("", words))
    if "encoders.yaw_ratio" not in estimate.names:
        words = "the log has neither a gyro nor a pose: nothing says how far the body turns for what the wheels do"
        return result | {"separation_multiplier": _missing("", words)}
    ratio = estimate.part(["encoders.yaw_ratio"])
    if geometry is None or separation is None:
        by_odometry = _estimated(ratio, "", "")
        if by_odometry.value is None:
            return result | {"separation_multiplier": by_odometry}
        words = (
            "without wheel speeds only a ratio is known: multiply the one that the odometry of this log was made with "
            f"by {by_odometry.value:.4g} [{by_odometry.interval[0]:.4g}, {by_odometry.interval[1]:.4g}]"
        )
        return result | {"separation_multiplier": _missing("", words)}
    wide = ratio.derived(["track"], lambda row: row * geometry.track / separation)
    reason = f"yaw rate of the wheels over that of the gyro, on a separation of {separation:.4g} m"
    return result | {"separation_multiplier": _sure(_estimated(wide, "", reason))}


def _sure(quantity: Quantity) -> Quantity:
    """Return the quantity; missing where its interval is too wide to be of use."""
    low, high, most = *quantity.interval, stack_settings().max_half_interval
    if quantity.value is None or 0.5 * (high - low) <= most * abs(quantity.value):
        return quantity
    return _missing(
        quantity.unit, f"the log tells only {low:.3g} to {high:.3g} {quantity.unit}: drive with larger steps"
    )


def _delays(point: Point, estimate: ParameterEstimate, dt: float) -> dict[str, Quantity]:
    """Return dead time and both lags together [s] of either channel: the delay that represents the whole response."""
    # A ramp is taken at the end of each part of a sample, so that the rest of the delay seems longer by half a part.
    ahead = 0.5 * dt / PARTS if "slew.v" in point else 0.0
    result = {}
    for channel in CHANNELS:
        names = [f"{kind}.{channel}" for kind in ("dead_time", "lag")] + [f"damping.{channel}"]

        def late(row: FloatArray, names: Sequence[str] = names) -> FloatArray:
            moved = {**point, **dict(zip(estimate.names, row.tolist(), strict=True))}
            dead, lag, damping = (moved.get(name, 1.0) for name in names)
            return np.array([dead + 2.0 * lag * damping - ahead])

        dead = point[names[0]]
        delay = _estimated(
            estimate.derived(["delay"], late), "s", f"dead time of {dead:.3g} s and lag of the answer of {channel}"
        )
        if delay.value is not None:
            # Errors that last through a log, such as a slow disturbance, are larger than the residuals indicate.
            half = 0.5 * stack_settings().delay_widening * (delay.interval[1] - delay.interval[0])
            delay = replace(delay, interval=(max(0.0, delay.value - half), delay.value + half))
        result[f"delay.{channel}"] = delay
    return result


def _limits(
    largest: FloatArray, point: Point, estimate: ParameterEstimate, corrected: Sequence[bool]
) -> dict[str, Quantity]:
    """Return speeds and accelerations at which the robot stops to follow.

    Other packages limit commands. With a multiplier, of (2,) `corrected` channels, a command is the body's motion: the
    command of the log times the gain. Without one it is that of the log. A limit whose interval reaches the `largest`
    (2,) command of the log was not reached.
    """
    result = {}
    for most, channel, multiplied in zip(largest.tolist(), CHANNELS, corrected, strict=True):
        unit, gain = _UNITS[channel], point[f"gain.{channel}"]
        name = "separation multiplier" if channel == "omega" else "radius multipliers"
        part, words = ["command"], "; for the multipliers of the log"
        if multiplied:
            part, words = ["body"], f", times its gain; only with the {name} of ros2_control.yaml"
        top, rate = (_in_the_body(estimate, kind, channel) for kind in ("limit", "slew"))
        # An interval that is not finite cannot be checked here: `_estimated` says so.
        reached = top is not None and not top.values[1] + 1.96 * top.deviation("command") >= most
        result[f"max.{channel}"] = (
            _sure(_estimated(top.part(part), unit, f"where the robot clips its command{words}"))
            if top is not None and reached
            else _missing(unit, f"not reached in this log, which drives up to {gain * most:.3g} {unit}")
        )
        result[f"rate.{channel}"] = (
            _sure(_estimated(rate.part(part), f"{unit}^2", f"slope at which the robot ramps its command{words}"))
            if rate is not None
            else _missing(f"{unit}^2", "no slope of the command is too steep for the robot in this log")
        )
        driven = gain * min(most, float(top.values[1]) if top is not None and reached else most)
        result[f"driven.{channel}"] = _stated(driven, unit, "largest command that the robot follows, times the gain")
    return result


def _in_the_body(estimate: ParameterEstimate, kind: str, channel: str) -> ParameterEstimate | None:
    """Return a bound of the command times the gain, and of the command; None where there is none."""
    names = [f"{kind}.{channel}", f"gain.{channel}"]
    if names[0] not in estimate.names:
        return None
    return estimate.part(names).derived(["body", "command"], lambda pair: np.array([pair[0] * pair[1], pair[0]]))


def _variances(data: LogData) -> dict[str, Quantity]:
    """Return variances of the readings of encoders and gyro about their neighbours."""
    sources = {"v": ("twist", 0), "omega": ("twist", 1), "gyro": ("yaw_rate", 0)}
    result = {}
    for name, (signal, column) in sources.items():
        unit = "(m/s)^2" if name == "v" else "(rad/s)^2"
        blocks = _scatter_by_block(data.train, signal, column)
        if len(blocks) < stack_settings().min_blocks:
            result[f"variance.{name}"] = _missing(unit, f"the log has too few readings of {name} to tell its noise")
            continue
        mean, error = float(blocks.mean()), float(blocks.std(ddof=1) / math.sqrt(len(blocks)))
        if not math.isfinite(mean + error):
            result[f"variance.{name}"] = _missing(unit, f"the scatter of the readings of {name} is not finite")
            continue
        reason = f"scatter of the readings about their neighbours, {len(blocks)} blocks; slip is not in it"
        result[f"variance.{name}"] = Quantity(mean, (max(0.0, mean - 2 * error), mean + 2 * error), unit, reason)
    return result


def _scatter_by_block(records: Sequence[Record], signal: str, column: int) -> FloatArray:
    """Return the variance (B,) of the random part of one column of a signal, in each block of the settings' length.

    Each block counts the second differences of its readings; blocks with fewer than fifty are left out.
    """
    variances = []
    for record in records:
        span = max(1, round(identification_settings().block_time / record.dt))
        for first in range(0, len(record.command), span):
            second = second_differences(record.part(first, min(first + span, len(record.command))), signal, [column])
            if second.size >= MIN_READINGS:
                variances.append(float(np.mean(second**2)) / SECOND_DIFFERENCE**2)
    return np.array(variances)


def look_ahead_factor(phase_margin: float) -> float:
    """Return the least look-ahead time of pure pursuit over the delay of the robot [-], for a phase margin [rad].

    On a straight path pure pursuit steers with the curvature -2 (y + L psi) / L^2. With y' = v psi, psi' = v curvature,
    p = s L / v and theta = delay v / L its open loop is 2 (p + 1) exp(-theta p) / p^2: its gain is 1 at w^2 = 2 +
    sqrt(8), where the phase is atan(w) - w theta above -pi. So L / v = delay w / (atan(w) - margin). Source of the
    idea: Ollero, Heredia, "Stability analysis of mobile robot path tracking", IROS 1995.
    """
    crossing = math.sqrt(2.0 + math.sqrt(8.0))
    return crossing / (math.atan(crossing) - phase_margin)


def _look_ahead(quantities: Quantities) -> dict[str, Quantity]:
    """Return the look-ahead of regulated pure pursuit from the delay of omega and half a period of the controller."""
    late, settings = quantities["delay.omega"], stack_settings()
    frequency = _stated(settings.controller_frequency, "Hz", "Nav2's default: the look-ahead holds for it")
    if late.value is None:
        words = f"the delay of omega is not known: {late.reason}"
        units = {"look_ahead_time": "s", "look_ahead": "m", "min_look_ahead": "m", "max_look_ahead": "m"}
        return {**{name: _missing(unit, words) for name, unit in units.items()}, "controller_frequency": frequency}
    factor, wait = look_ahead_factor(math.radians(settings.phase_margin)), 0.5 / settings.controller_frequency
    reason = (
        f"{factor:.3g} times the delay of omega and half a period at {settings.controller_frequency:g} Hz: phase "
        f"margin of {settings.phase_margin:g} degrees on a straight path"
    )

    def look_ahead(speed: float, unit: str, words: str) -> Quantity:
        low, value, high = (
            speed * factor * (end + wait) for end in (late.interval[0], late.value or 0.0, late.interval[1])
        )
        return Quantity(value, (low, high), unit, words)

    fast = quantities["driven.v"].value or 0.0
    slow = min(settings.slow_speed, fast)
    return {
        "look_ahead_time": look_ahead(1.0, "s", reason),
        "look_ahead": look_ahead(fast, "m", f"look-ahead time at {fast:.3g} m/s, the robot's fastest in this log"),
        "min_look_ahead": look_ahead(slow, "m", f"look-ahead time at {slow:.3g} m/s"),
        "max_look_ahead": look_ahead(fast, "m", f"look-ahead time at {fast:.3g} m/s, the robot's fastest in this log"),
        "controller_frequency": frequency,
    }


def interval_words(quantity: Quantity) -> str:
    """Return the interval with its unit, followed by a comma and a blank."""
    low, high = quantity.interval
    unit = f" {quantity.unit}" if quantity.unit else ""
    return f"[{low:.{DIGITS}g}, {high:.{DIGITS}g}]{unit}, " if low < high else f"{quantity.unit}, "


def quantity_table(quantities: Quantities) -> TextTable:
    """Return a row for each quantity, known or not."""
    rows = [
        (
            name,
            "-" if part.value is None else f"{part.value:.{DIGITS}g}",
            "not known" if part.value is None else interval_words(part).rstrip(", "),
            part.reason,
        )
        for name, part in quantities.items()
    ]
    note = "Intervals of 95 %. The files say which parameter each is."
    return TextTable(
        "For other packages", ("what", "value", "interval", "reason"), tuple(rows), text_columns=4, note=note
    )
