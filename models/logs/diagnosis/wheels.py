"""Detection of encoder faults: dead, reversed, exchanged or uneven sides, and running counts."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.agreement import change_location
from diffdrive_mpc.models.logs.diagnosis.streams import ENCODERS, Streams, fit_response
from diffdrive_mpc.models.logs.record import Finding, MappingChange

SIDES = ("left", "right")
_NAMES = {2: SIDES, 4: ("front_left", "front_right", "rear_left", "rear_right")}


def check_wheels(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding about the encoders; correct or remove them in `streams`."""
    if streams.twist is None:
        return []
    check = _dead_side_of_twist if streams.wheels is None else _check_each_wheel
    finding = check(log, streams, settings)
    return [] if finding is None else [finding]


def check_order(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the sides of the encoders are exchanged during the log."""
    if streams.twist is None or streams.wheels is None:
        return []
    command, omega = streams.command[:, 1], streams.twist[:, 1]
    original = fit_response(streams, command, omega, settings)
    if original is None or abs(original.correlation[0]) > settings.clear_correlation:
        return []
    known = np.flatnonzero(np.isfinite(streams.time))
    starts = known[np.linspace(0, len(known) - 1, 4 * settings.part_count + 1).astype(int)[1:-1]]

    def correlation(start: int) -> float:
        exchanged = np.where(np.arange(len(omega)) < start, omega, -omega)
        response = fit_response(streams, command, exchanged, settings)
        return 0.0 if response is None else abs(float(response.correlation[0]))

    correlations = [correlation(int(start)) for start in starts]
    index = int(np.argmax(correlations))
    if correlations[index] < settings.clear_correlation:
        return []
    # Both parts must respond clearly, one of them with inverted sign. A steady part after a change of speed does not
    # determine the order of the sides.
    before = np.arange(len(omega)) < starts[index]
    parts = [fit_response(streams, command, np.where(part, omega, np.nan), settings) for part in (before, ~before)]
    signed = [0.0 if part is None else float(part.correlation[0]) for part in parts]
    if min(np.abs(signed)) < settings.clear_correlation or signed[0] * signed[1] > 0.0:
        return []
    times = streams.time[starts]
    message = (
        f"left and right of the encoders are exchanged from about {times[index]:.0f} s on, which inverts omega: the "
        "order of the joints changed; split the log there and identify from one part"
    )
    return [Finding("order change", "error", log, message, *change_location(times, index))]


def check_counts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the encoder readings are running counts; remove them from `streams`."""
    if streams.twist is None:
        return []
    response = fit_response(streams, streams.command, streams.twist, settings)
    if response is None or response.correlation.max() > settings.clear_correlation:
        return []
    rate = streams.map_stretches(
        lambda part: np.gradient(part, streams.dt, axis=0) if len(part) > 1 else part * np.nan, streams.twist
    )
    rate_response = fit_response(streams, streams.command, rate, settings)
    if rate_response is None or rate_response.correlation.min() < settings.clear_correlation:
        return []
    streams.twist = streams.wheels = None
    message = (
        "the changes of the encoder readings follow the command, the readings do not: they are running counts; set "
        "`unit: ticks` for their columns, and `ticks_per_turn` under 'wheels'"
    )
    return [Finding("running counts", "error", log, message)]


def _check_each_wheel(log: str, streams: Streams, settings: CheckSettings) -> Finding | None:
    """Return the finding based on the response of each wheel to the commands of both sides."""
    assert streams.wheels is not None and streams.twist is not None
    names = _NAMES[streams.wheels.shape[1]]
    present = np.isfinite(streams.wheels).all(axis=1)
    size = np.sqrt(np.mean(streams.wheels[present] ** 2, axis=0)) if present.any() else np.zeros(len(names))
    is_dead = size < settings.dead_wheel * size.max()
    if is_dead.any() and not is_dead.all():
        message = (
            f"the wheel '{names[int(np.argmax(is_dead))]}' reads zero while the others turn: check its encoder or its "
            "column"
        )
        streams.twist = streams.wheels = None
        return Finding("dead wheel", "error", log, message)
    difference = streams.wheels[:, 1::2].mean(axis=1) - streams.wheels[:, ::2].mean(axis=1)
    command, omega = streams.command[:, 1], streams.twist[:, 1]
    is_exchanged = _cosine(difference, omega) < -settings.clear_correlation
    if is_exchanged and _cosine(command, omega) > settings.weak_correlation:
        message = (
            "the wheels turn the robot in the opposite direction to omega of the encoders and of the command: exchange "
            "left and right of the wheels"
        )
        return Finding("swapped sides", "error", log, message, changes=(MappingChange(ENCODERS, "sides", "exchanged"),))
    sides = commanded_sides(streams)
    response = None if sides is None else fit_response(streams, sides, streams.wheels, settings)
    if sides is None or response is None or response.correlation.max() < settings.clear_correlation:
        return None
    gain = response.gain.T  # rows: wheels; columns: commanded left, right
    direct = np.array([gain[i, i % 2] for i in range(len(names))])
    crossed = np.array([gain[i, 1 - i % 2] for i in range(len(names))])
    # On a circle the commands of both sides are proportional, so the sides cannot be distinguished.
    is_distinct = not _are_collinear(sides, settings)
    if is_distinct and (np.abs(crossed) > 2 * np.abs(direct)).all():
        if (crossed < 0).all():
            return None  # sides are exchanged and reversed, as if the robot drove backwards; `check_signs` reports v
        pairs = [streams.pair(ENCODERS, name, 1) for name in streams.sensors(1) if name != ENCODERS]
        responses = [fit_response(streams, *pair, settings, both_measured=True) for pair in pairs]
        if responses and all(r and r.signed_correlation > settings.clear_correlation for r in responses):
            return None  # the body turns as the encoders, not as the command; `check_signs` reports the command
        streams.twist = streams.twist * [1.0, -1.0]
        message = (
            "each side of the encoders follows the command of the other side: exchange left and right of the encoders, "
            "or of the commands"
        )
        change = MappingChange(ENCODERS, "omega.sign" if streams.has_twist_columns else "sides", -1)
        return Finding("swapped sides", "error", log, message, changes=(change,))
    is_direct = (np.abs(direct) > np.abs(crossed)) | (not is_distinct)
    # If both sides move alike, the joint gains are uncertain, but the gain from the command of the same side is not.
    side_gains = np.array([_single_gain(streams, sides[:, i % 2], i, settings) for i in range(len(names))])
    is_reversed = is_direct & (side_gains < 0)
    if is_reversed.any() and not is_reversed.all():
        reversed_names = [name for name, flag in zip(names, is_reversed, strict=True) if flag]
        quoted = " and ".join(f"'{name}'" for name in reversed_names)
        message = f"the wheel {quoted} turns in the opposite direction to its command, the others do not"
        streams.twist = streams.wheels = None
        changes = tuple(MappingChange("encoders", f"{name}.sign", -1) for name in reversed_names)
        return Finding("reversed wheel", "error", log, message, changes=changes)
    # Uneven wheels differ in the joint and in the single gains. A wrong unit of the command changes all gains; if the
    # sides are not distinct, at least one gain must therefore be plausible.
    gains, (low, high) = np.abs(side_gains), settings.gain_of_v
    is_uneven = gains.min() * settings.uneven_wheels < gains.max()
    if is_distinct:
        is_uneven &= np.abs(direct).min() * settings.uneven_wheels < np.abs(direct).max()
    else:
        is_uneven &= ((low < gains) & (gains < high)).any()
    if is_direct.all() and is_uneven:
        ratios = gains / np.median(gains) if len(gains) > 2 else np.abs(np.diag(response.gain))
        outlier = int(np.argmax(np.abs(np.log(ratios))))
        reference = float(np.median(np.delete(gains, outlier)))
        message = (
            f"the wheel '{names[outlier]}' reads {gains[outlier] / reference:.3g} times as fast as the "
            f"other{'s' if len(names) > 2 else ''} for the same "
            "command: correct the unit of its column, or check its ticks per turn"
        )
        streams.twist = streams.wheels = None
        return Finding("uneven wheels", "error", log, message)
    return _late_wheel(log, streams, sides, response.lag, settings) if is_distinct and len(names) == 2 else None


def _late_wheel(log: str, streams: Streams, sides: FloatArray, lag: float, settings: CheckSettings) -> Finding | None:
    """Return the finding if the encoder of one side responds later than that of the other."""
    assert streams.wheels is not None
    fits = [fit_response(streams, sides, wheel, settings, intervals=True, lags=[lag]) for wheel in streams.wheels.T]
    left, right = ((np.nan, np.nan) if fit is None else (fit.dead_time, fit.deviation) for fit in fits)
    delay, deviation = right[0] - left[0], float(np.hypot(*np.nan_to_num([left[1], right[1]])))
    if not abs(delay) > max(settings.wheel_delay, 3 * deviation):
        return None
    streams.twist = streams.wheels = None
    message = (
        f"the encoder of the {SIDES[int(delay > 0)]} side is {abs(delay):.2f} +- {1.96 * deviation:.2f} s later than "
        "the other: read both at the same time, or log the time of each reading"
    )
    return Finding("late wheel", "warning", log, message)


def _single_gain(streams: Streams, side: FloatArray, wheel: int, settings: CheckSettings) -> float:
    assert streams.wheels is not None
    response = fit_response(streams, side, streams.wheels[:, wheel], settings)
    return np.nan if response is None else response.size


def _cosine(first: FloatArray, second: FloatArray) -> float:
    """Return the correlation of two signals (N,) about zero, which is also valid for constant signals."""
    known = np.isfinite(first) & np.isfinite(second)
    size = float(np.linalg.norm(first[known]) * np.linalg.norm(second[known]))
    return float(first[known] @ second[known]) / size if size > 0 else 0.0


def _are_collinear(sides: FloatArray, settings: CheckSettings) -> bool:
    present = sides[np.isfinite(sides).all(axis=1)]
    return bool(abs(np.asarray(np.corrcoef(present.T))[0, 1]) > settings.collinearity)


def commanded_sides(streams: Streams) -> FloatArray | None:
    """Compute the commanded wheel speeds (N, 2) of both sides [rad/s], with the radius and track of the mapping.

    The result is None if the log has no wheel speeds, or if they do not determine radius and track.
    """
    if streams.wheels is None or streams.twist is None:
        return None
    present = np.isfinite(streams.wheels).all(axis=1) & np.isfinite(streams.twist).all(axis=1)
    wheels, twist = streams.wheels[present], streams.twist[present]
    mean = wheels.mean(axis=1)
    difference = wheels[:, 1::2].mean(axis=1) - wheels[:, ::2].mean(axis=1)
    if not (mean @ mean > 0 and difference @ difference > 0):
        return None
    # The mapping computed v = r mean and omega = r difference / b from these wheel speeds, so both ratios are exact.
    radius = abs(float(mean @ twist[:, 0]) / float(mean @ mean))
    radius_over_track = abs(float(difference @ twist[:, 1]) / float(difference @ difference))
    if radius == 0 or radius_over_track == 0:
        return None
    half = 0.5 * streams.command[:, 1] / radius_over_track
    middle = streams.command[:, 0] / radius
    return np.column_stack([middle - half, middle + half])


def _dead_side_of_twist(log: str, streams: Streams, settings: CheckSettings) -> Finding | None:
    """Return the finding for a dead side in a log without wheel speeds; it makes v and omega proportional."""
    assert streams.twist is not None
    present = np.isfinite(streams.twist).all(axis=1) & np.isfinite(streams.command).all(axis=1)
    twist, command = streams.twist[present], streams.command[present]
    if len(twist) < 2 or np.ptp(command, axis=0).min() == 0 or np.ptp(twist, axis=0).min() == 0:
        return None
    measured_correlation, commanded_correlation = (float(np.corrcoef(*part.T)[0, 1]) for part in (twist, command))
    if abs(measured_correlation) < settings.collinearity or abs(commanded_correlation) > settings.clear_correlation:
        return None
    side = "left" if measured_correlation > 0 else "right"
    streams.twist = None
    message = (
        f"v and omega of the encoders are proportional (correlation {measured_correlation:.2f}), those of the command "
        f"are not: the {side} wheel reads zero; repair its encoder"
    )
    return Finding("dead wheel", "error", log, message)
