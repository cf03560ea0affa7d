"""Checks of signs, units and axes by comparison of streams that measure the same quantity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.limits import apply_best_limits
from diffdrive_mpc.models.logs.diagnosis.streams import (
    COMMAND,
    ENCODERS,
    GYRO,
    POSE,
    StreamResponse,
    Streams,
    jackknife,
    residual_variance,
    steady_gain,
)
from diffdrive_mpc.models.logs.mapping import FACTORS, FOUR_WHEELS, POSE_UNITS, SIDES, TWIST_UNITS
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.logs.record_checks import REMEDY
from diffdrive_mpc.models.velocity_model import CHANNELS

_SAME_FACTOR = 0.1
"""Maximum log ratio of indistinguishable units: for a wheel radius of 0.16 m, m/s and rev/s have equal factors."""


def check_swap(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: v and omega of the command are exchanged; correct `streams`.

    Every sensor then follows the command of the other channel. A reversed wheel has the same effect on the encoders,
    but not on gyro and pose.
    """
    if streams.commands_wheels or {GYRO, POSE}.isdisjoint(streams.sensors(1)):
        return []

    def correlations(command: FloatArray) -> FloatArray:
        tested = replace(streams, command=command)
        responses = (tested.command_responses(channel, settings).values() for channel in (0, 1))
        return np.array([response.signed_correlation for part in responses for response in part])

    exchanged = streams.command[:, ::-1]
    before, after = correlations(streams.command), np.abs(correlations(exchanged))
    if len(before) != len(after) or min(after, default=0.0) < settings.clear_correlation:
        return []
    # The paths of some drives correlate v with omega, so that both orders explain a part of every reading.
    if (1.0 - after**2 > settings.shape_ratio * (1.0 - np.maximum(before, 0.0) ** 2)).any():
        return []
    streams.command = exchanged
    message = "v of the sensors follows omega of the command, and omega follows v: exchange v and omega of the command"
    return [
        Finding("swapped channels", "error", log, message, changes=(MappingChange(COMMAND, "channels", "exchanged"),))
    ]


def check_heading_unit(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the heading agrees with the path only in another unit; correct `streams`."""
    stated = streams.stated_unit(POSE, "theta")
    if streams.pose is None or not stated or abs(_mean_directions(streams)[0]) > settings.clear_correlation:
        return []
    unit = "rad" if stated == "deg" else "deg"
    offset = streams.heading_offset
    theta = (streams.pose[:, 2] + offset) * FACTORS[unit] / FACTORS[stated] - offset
    known = np.isfinite(theta)
    theta[known] = np.unwrap(theta[known])
    tested = replace(streams, pose=np.column_stack([streams.pose[:, :2], theta]))
    if abs(_mean_directions(tested)[0]) < settings.clear_correlation:
        return []
    streams.pose = tested.pose
    message = f"the heading of the pose agrees with its path only in {unit}: its column is in {unit}, not in {stated}"
    return [Finding("wrong unit", "error", log, message, changes=(MappingChange(POSE, "theta.unit", unit),))]


def check_axes(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about poses whose axes, heading and motion are inconsistent; correct `streams`."""
    if streams.pose is None:
        return []
    relations = streams.command_responses(1, settings)
    is_inverted = POSE in relations and relations[POSE].signed_correlation < settings.wrong_sign
    regular, mirrored = _mean_directions(streams)
    if abs(mirrored) < settings.clear_correlation or abs(mirrored) < 1.5 * abs(regular):
        return _rotation_finding(log, streams, settings)
    if is_inverted:
        streams.pose = streams.pose * [1.0, 1.0, -1.0]
        message = "omega of the pose has the opposite sign to the command and to the path of the pose"
        return [Finding("wrong sign", "error", log, message, changes=(MappingChange(POSE, "theta.sign", -1),))]
    angle = math.degrees(np.angle(mirrored))
    if abs(abs(angle) - 90) < 30:
        streams.pose = streams.pose[:, [1, 0, 2]]
        message = "the pose moves as if x and y were exchanged: exchange the columns of 'x' and 'y' of the pose"
        change = MappingChange(POSE, "axes", "exchanged")
    else:
        axis = 1 if abs(angle) < 45 else 0
        streams.pose = streams.pose * np.where(np.arange(3) == axis, -1.0, 1.0)
        name = "xy"[axis]
        message = "the path of the pose is mirrored relative to its heading"
        change = MappingChange(POSE, f"{name}.sign", -1)
    return [Finding("mirrored pose", "error", log, message, changes=(change,))]


def _mean_directions(streams: Streams) -> tuple[complex, complex]:
    """Return the means of the direction of motion of the pose, and of its conjugate, relative to the heading.

    The motion in the frame of a correct pose is real and positive. For a mirrored pose, the conjugate of the motion is
    constant instead, and its angle indicates the wrong axis. Both are 0 if the pose does not move.
    """
    assert streams.pose is not None
    direction = np.sign(streams.delay(streams.low_pass(streams.command[:, 0], 0.1), 0.2))
    step = streams.pose_rates()
    motion, heading = step[:, 0] + 1j * step[:, 1], np.exp(-1j * streams.pose[:, 2])
    is_used = np.isfinite(motion) & np.isfinite(heading) & np.isfinite(direction)
    size = float((np.abs(motion[is_used]) * np.abs(direction[is_used])).sum())
    if size == 0 or np.ptp(streams.command[is_used, 0]) == 0:
        return 0.0, 0.0
    relative = (heading * direction)[is_used] / size
    return complex((motion[is_used] * relative).sum()), complex((np.conj(motion[is_used]) * relative).sum())


def _rotation_finding(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return the finding for a constant angle between the heading of the pose and the direction of motion.

    A point away from the centre of rotation also moves sideways in proportion to omega, and a skidding body in
    proportion to v omega; a regression separates these parts from the rotation. In a drive along a circle it cannot,
    so the angle must be significant.
    """
    assert streams.pose is not None
    step = streams.pose_rates()
    velocity = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * streams.pose[:, 2])
    v = streams.smooth(streams.delay(streams.low_pass(streams.command[:, 0], 0.1), 0.2))
    rows = np.column_stack([v, step[:, 2], v * step[:, 2]]).astype(complex)
    is_used = np.isfinite(velocity) & np.isfinite(rows).all(axis=1)
    rows, velocity, commands = rows[is_used], velocity[is_used], streams.command[is_used]
    if np.ptp(commands, axis=0).min() > 0 and abs(np.corrcoef(commands.T)[0, 1]) > settings.collinearity:
        return []  # the effects of v and omega cannot be separated
    angle, deviation = jackknife(rows, velocity, lambda row: float(np.angle(row[0])))
    explained = 1 - residual_variance(rows, velocity) / max(float(np.mean(np.abs(velocity) ** 2)), 1e-300)
    # Half a turn indicates a wrong sign.
    is_clear = max(settings.pose_rotation, settings.significance * deviation) < abs(angle) < np.pi - 0.5
    if explained < settings.clear_correlation**2 or not is_clear:
        return []
    streams.pose = streams.pose + [0.0, 0.0, angle]
    message = (
        f"the pose moves at {math.degrees(angle):.0f} +- {math.degrees(1.96 * deviation):.0f} deg to its heading: "
        "its frame is rotated relative to the robot"
    )
    return [Finding("turned pose", "warning", log, message, changes=(_turned_by(-angle, streams),))]


def _turned_by(angle: float, streams: Streams) -> MappingChange:
    """Return the change that adds an angle [rad] to the heading offset in the mapping."""
    offset = math.remainder(streams.heading_offset + angle, math.tau)
    return MappingChange(POSE, "heading_offset", round(offset, 4) + 0.0)  # no negative zero


def _swapped_sides_finding(log: str, relations: dict[str, StreamResponse], streams: Streams) -> Finding | None:
    """Return the finding if gyro and pose have the opposite sense of rotation to the encoders; correct `streams`."""
    body_sensors, encoders = [name for name in (GYRO, POSE) if name in relations], relations.get(ENCODERS)
    if len(body_sensors) < 2 or encoders is None or streams.wheels is None or encoders.signed_correlation < 0:
        return None
    if any(relations[name].signed_correlation > 0 for name in body_sensors):
        return None
    for name in (COMMAND, ENCODERS):
        _scale(streams, name, 1, -1.0)
    message = (
        "omega of gyro and pose has the opposite sign to command and encoders: exchange left and right of the "
        "encoders and of the commands"
    )
    changes = (*_sign_changes(ENCODERS, 1, streams), *_sign_changes(COMMAND, 1, streams))
    return Finding("swapped sides", "error", log, message, changes=changes)


def check_signs(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about unresponsive and inverted streams; remove or correct them in `streams`."""
    findings = []
    for channel in (0, 1):
        relations = streams.command_responses(channel, settings)
        if not relations:
            continue
        max_correlation = max(abs(relation.signed_correlation) for relation in relations.values())
        for name, relation in list(relations.items()):
            if (
                abs(relation.signed_correlation) < settings.weak_correlation
                or -settings.weak_correlation > relation.signed_correlation > settings.wrong_sign
            ):
                gain, interval = steady_gain(streams, name, channel, relation.dead_time, settings)
                if interval < settings.known_gain * abs(gain):
                    findings.append(_steady_finding(log, name, channel, relation))
                    continue
                findings.append(_weak_finding(log, name, channel, relation, max_correlation, settings))
                streams.remove(name)
                del relations[name]
        if channel == 1 and (swapped := _swapped_sides_finding(log, relations, streams)):
            findings.append(swapped)
            continue
        inverted = [name for name, relation in relations.items() if relation.signed_correlation < 0]
        if not inverted:
            continue
        all_inverted = len(inverted) > 1 and len(inverted) == len(relations)
        for name in [COMMAND] if all_inverted else inverted:
            signal = f"{CHANNELS[channel]} of the {name}"
            reference = "all sensors" if all_inverted else "the command"
            has_wheels = name == ENCODERS and channel == 0 and not streams.has_twist_columns
            minimum = (
                min(relation.signed_correlation for relation in relations.values())
                if all_inverted
                else relations[name].signed_correlation
            )
            message = f"{signal} has the opposite sign to {reference} (correlation {minimum:.2f})"
            changes = _sign_changes(name, channel, streams)
            _scale(streams, name, channel, -1.0)
            if (
                has_wheels
                and ENCODERS in (others := streams.command_responses(1, settings))
                and others[ENCODERS].signed_correlation < 0
            ):
                _scale(streams, ENCODERS, 1, -1.0)  # reversed wheels invert both v and omega
                changes = changes[1:]  # without the exchange of the sides
            findings.append(Finding("wrong sign", "error", log, message, changes=changes))
    return findings


def _weak_finding(
    log: str, name: str, channel: int, relation: StreamResponse, max_correlation: float, settings: CheckSettings
) -> Finding:
    restarts = ": where poses restart, `segment` in the mapping names a column that changes" if name == POSE else ""
    correlation = relation.signed_correlation
    message = (
        f"{CHANNELS[channel]} of the {name} hardly follows the command (correlation {correlation:.2f}); check the "
        f"column{restarts}; and that the robot executed these commands, or leave the {name} out of the mapping"
    )
    # The sensor is faulty if another sensor responds.
    is_faulty = max_correlation > settings.clear_correlation
    return Finding("weak response", "error" if is_faulty else "warning", log, message)


def _steady_finding(log: str, name: str, channel: int, relation: StreamResponse) -> Finding:
    """Return the finding for a sensor that follows a nearly constant command in the mean only."""
    message = (
        f"{CHANNELS[channel]} is nearly constant: its changes do not show in the noise of the {name} (correlation "
        f"{relation.signed_correlation:.2f}), although its mean does; {REMEDY}"
    )
    return Finding("little excitation", "warning", log, message)


def check_units(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about streams whose scale contradicts that of the others; correct `streams`."""
    findings: list[Finding] = []
    for channel in (0, 1):
        low, high = settings.gain_of_v if channel == 0 else settings.gain_of_omega
        sizes = _magnitudes(streams, channel, settings)
        if len(sizes) > 1 and _find_outlier(sizes, low, high) is not None:
            # A limit of the base also reduces the response; unless it is applied, this appears as a wrong unit.
            streams.command = apply_best_limits(streams, channel, settings).command
            sizes = _magnitudes(streams, channel, settings)
        while len(sizes) > 1:
            outlier = _find_outlier(sizes, low, high)
            if outlier is None:
                break
            if (
                outlier == ENCODERS
                and len(sizes) == 2
                and streams.commands_wheels
                and _has_wrong_command_unit(streams, settings)
            ):
                outlier = COMMAND
            # Gyro and pose both measure the body, so compare them; wheels follow their commands despite skid.
            partner = {GYRO: POSE, POSE: GYRO, COMMAND: ENCODERS}.get(outlier, "") if channel == 1 else ""
            others = [partner] if partner in sizes else [name for name in sizes if name != outlier]
            # A body with skidding wheels turns less than the wheels indicate.
            skid = settings.typical_skid if channel == 1 and outlier in (GYRO, POSE) and partner not in sizes else 1.0
            ratio = sizes[outlier] / float(np.exp(np.median([np.log(sizes[name]) for name in others])))
            finding = _unit_finding(log, outlier, channel, ratio, others, skid, streams, settings)
            is_pose_right = outlier == POSE and (
                not finding.changes
                if channel == 0
                else abs(_mean_directions(streams)[0]) > settings.clear_correlation  # the heading follows the path
            )
            has_ticks = "ticks" in streams.stated_unit(outlier, _columns(outlier, channel, streams)[0])
            if is_pose_right or (len(sizes) == 2 and not finding.changes and not has_ticks):
                # If the outlier is right, all other streams are in a wrong unit; they are corrected one after another.
                ratios = {name: size / sizes[outlier] for name, size in sizes.items() if name != outlier}
                is_body = channel == 1 and outlier in (GYRO, POSE)
                skids = {name: 1 / settings.typical_skid if is_body and name != GYRO else 1.0 for name in ratios}
                alternatives = [
                    _unit_finding(log, name, channel, ratios[name], [outlier], skids[name], streams, settings)
                    for name in ratios
                ]
                if all(alternative.changes for alternative in alternatives):
                    outlier, ratio, finding = *next(iter(ratios.items())), alternatives[0]
            findings.append(finding)
            sizes.pop(outlier)
            _scale(streams, outlier, channel, 1 / ratio)
    return findings


def _magnitudes(streams: Streams, channel: int, settings: CheckSettings) -> dict[str, float]:
    """Return the magnitude of each stream of a channel relative to the command."""
    relations = streams.command_responses(channel, settings)
    return {COMMAND: 1.0} | {name: abs(relation.size) for name, relation in relations.items() if relation.size}


def _has_wrong_command_unit(streams: Streams, settings: CheckSettings) -> bool:
    """Return True if the magnitudes of omega indicate a wrong unit of the wheel commands instead of the encoders."""
    sizes = _magnitudes(streams, 1, settings)
    return len(sizes) > 2 and _find_outlier(sizes, *settings.gain_of_omega) == COMMAND


def _find_outlier(sizes: dict[str, float], low: float, high: float) -> str | None:
    """Return the stream with the largest implausible ratio to the median of the others; in a tie, the sensor."""
    log_sizes = {name: math.log(size) for name, size in sizes.items()}
    selected = None
    for name in sizes:
        others = [value for other_name, value in log_sizes.items() if other_name != name]
        difference = log_sizes[name] - float(np.median(others))
        bound = (low, high) if name not in (COMMAND, ENCODERS) else (1 / high, 1 / low)
        is_outside = not math.log(bound[0]) <= difference <= math.log(bound[1])
        # In a tie between sensor and command, select the sensor.
        rank = (abs(difference) if is_outside else -1.0, name != COMMAND)
        if is_outside and (selected is None or rank > selected[0]):
            selected = (rank, name)
    return None if selected is None else selected[1]


def _unit_finding(
    log: str,
    name: str,
    channel: int,
    ratio: float,
    others: Sequence[str],
    skid: float,
    streams: Streams,
    settings: CheckSettings,
) -> Finding:
    columns = _columns(name, channel, streams)
    factors = {unit: FACTORS[unit] for unit in (POSE_UNITS if name == POSE else TWIST_UNITS)[channel]}
    radius = _wheel_radius(streams)
    wheels = (name == ENCODERS and not streams.has_twist_columns) or (name == COMMAND and streams.commands_wheels)
    if wheels and radius is not None:
        factors = {unit: FACTORS[unit] for unit in ("rad/s", "rpm", "deg/s", "rev/s")} | {"m/s": 1 / radius}
    stated = streams.stated_unit(name, columns[0]) or next(iter(factors))
    geometry = streams.mapping.wheels
    ticks = geometry.ticks_per_turn if geometry and stated in ("ticks", "ticks/s") else None
    if stated == "ticks":
        factors = {}  # differences of running counts are not speeds in another unit
    elif ticks:
        factors[stated] = math.tau / ticks
    expected = skid * factors.get(stated, 1.0)
    deviation = {unit: abs(math.log(ratio * factor / expected)) for unit, factor in factors.items() if unit != stated}
    unit = min(deviation, key=deviation.__getitem__, default="")
    candidates = [name for name in deviation if deviation[name] < deviation[unit] + _SAME_FACTOR]
    changes: tuple[MappingChange, ...] = ()
    tolerance = settings.unit_tolerance * (1 + channel if skid == 1.0 else 3)
    if deviation and deviation[unit] < tolerance:
        remedy = f"its column is in {unit}, not in {stated}"
        if len(candidates) == 1:
            changes = tuple(MappingChange(name, f"{column}.unit", unit) for column in columns)
        else:
            alternatives = " or ".join(f"`unit: {candidate}`" for candidate in candidates)
            remedy = f"its column has {alternatives}; the log does not distinguish them"
    elif ticks:
        remedy = f"check `ticks_per_turn` under `wheels`: {ticks * ratio / skid:.4g} instead of {ticks:g} would agree"
    elif (name == ENCODERS or wheels) and ratio > settings.max_unit_gain:
        remedy = "its columns may count ticks: `unit: ticks/s` or `unit: ticks` in the mapping, and `ticks_per_turn`"
    else:
        remedy = "no unit of its column explains this; check all units, `sample_time`, and lengths under `wheels`"
    message = f"{CHANNELS[channel]} of the {name} is {ratio:.3g} times that of the {' and '.join(others)}; {remedy}"
    return Finding("wrong unit", "error", log, message, changes=changes)


def _columns(name: str, channel: int, streams: Streams) -> tuple[str, ...]:
    """Return the mapping keys of the columns of a channel."""
    if name == COMMAND:
        return SIDES if streams.commands_wheels else (CHANNELS[channel],)
    if name == ENCODERS:
        if streams.wheels is None or streams.has_twist_columns:
            return (CHANNELS[channel],)
        return SIDES if streams.wheels.shape[1] == len(SIDES) else FOUR_WHEELS
    if name == GYRO:
        return ("yaw_rate",)
    return ("x", "y") if channel == 0 else ("theta",)


def _sign_changes(name: str, channel: int, streams: Streams) -> tuple[MappingChange, ...]:
    """Return the changes that invert a channel."""
    columns = _columns(name, channel, streams)
    # With a large offset in the mapping, the offset is more likely wrong than both signs.
    if columns == ("x", "y") and abs(streams.heading_offset) > math.pi / 2:
        return (_turned_by(math.pi, streams),)
    if columns in (SIDES, FOUR_WHEELS):
        # Exchanged sides invert omega; inverted signs of all wheels invert v and omega.
        exchange = MappingChange(name, "sides", "exchanged")
        columns = columns if channel == 0 else ()
        return (exchange, *(MappingChange(name, f"{column}.sign", -1) for column in columns))
    return tuple(MappingChange(name, f"{column}.sign", -1) for column in columns)


def _wheel_radius(streams: Streams) -> float | None:
    """Return the wheel radius [m] with which the mapping computed v; None if there are no wheels."""
    if streams.wheels is None or streams.twist is None:
        return None
    mean, v = streams.wheels.mean(axis=1), streams.twist[:, 0]
    is_finite = np.isfinite(mean) & np.isfinite(v)
    size = float(mean[is_finite] @ mean[is_finite])
    return abs(float(mean[is_finite] @ v[is_finite])) / size if size > 0 else None


def _scale(streams: Streams, name: str, channel: int, factor: float) -> None:
    """Scale one channel of a stream, or both if they are computed from the same columns and `factor` is positive."""
    columns = np.where(np.arange(2) == channel, factor, 1.0)
    if name == COMMAND:
        shared = streams.commands_wheels and factor > 0
        streams.command = streams.command * (factor if shared else columns)
    elif name == ENCODERS and streams.twist is not None:
        shared = not streams.has_twist_columns and factor > 0
        streams.twist = streams.twist * (factor if shared else columns)
    elif name == GYRO and streams.yaw_rate is not None:
        streams.yaw_rate = streams.yaw_rate * factor
    elif name == POSE and streams.pose is not None:
        streams.pose = streams.pose * ([factor, factor, 1.0] if channel == 0 else [1.0, 1.0, factor])


def check_presence(log: str, streams: Streams) -> list[Finding]:
    """Return findings about sensors that stay constant under changing commands; remove them from `streams`."""
    findings = []
    for channel in (0, 1):
        command = streams.command[:, channel]
        if np.nanmax(command) == np.nanmin(command):
            continue
        for name in streams.sensors(channel):
            # Stretches shorter than the window of `pose_rates` have no speeds; use the coordinates of the pose instead.
            values = streams.channel(name, channel)
            if name == POSE and streams.pose is not None:
                values = streams.pose[:, :2] if channel == 0 else streams.pose[:, 2]
            assert values is not None
            readings = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
            if len(readings) and np.ptp(readings, axis=0).max() > 0:
                continue
            message = (
                f"{CHANNELS[channel]} of the {name} never changes, although the command does; check the column and "
                "the connection of the sensor"
            )
            findings.append(Finding("no response", "error", log, message))
            streams.remove(name)
    return findings
