"""Faults of the encoders of both sides: dead, reversed, exchanged, uneven, or counts."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.agreement import cut
from diffdrive_mpc.models.logs.diagnosis.streams import StreamResponse, Streams, fit_response
from diffdrive_mpc.models.logs.record import Finding, MappingChange

SIDES = ("left", "right")
_NAMES = {2: SIDES, 4: ("front_left", "front_right", "rear_left", "rear_right")}


def check_wheels(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding about the encoders, which are corrected in `streams` or removed."""
    if streams.twist is None:
        return []
    check = _sides_of_twist if streams.wheels is None else _each_wheel
    finding = check(log, streams, settings)
    return [] if finding is None else [finding]


def check_order(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: encoders whose sides are exchanged from some time on."""
    if streams.twist is None or streams.wheels is None:
        return []
    command, omega = streams.command[:, 1], streams.twist[:, 1]
    plain = fit_response(streams, command, omega, settings)
    if plain is None or abs(plain.correlation[0]) > settings.clear_correlation:
        return []
    known = np.flatnonzero(np.isfinite(streams.time))
    starts = known[np.linspace(0, len(known) - 1, 4 * settings.parts + 1).astype(int)[1:-1]]

    def correlation(start: int) -> float:
        turned = np.where(np.arange(len(omega)) < start, omega, -omega)
        response = fit_response(streams, command, turned, settings)
        return 0.0 if response is None else abs(float(response.correlation[0]))

    each = [correlation(int(start)) for start in starts]
    index = int(np.argmax(each))
    if each[index] < settings.clear_correlation:
        return []
    # Each part must follow by itself, one of them inverted: a change of speed and a steady stretch after it do not
    # determine the order.
    before = np.arange(len(omega)) < starts[index]
    parts = [fit_response(streams, command, np.where(part, omega, np.nan), settings) for part in (before, ~before)]
    alone = [0.0 if part is None else float(part.correlation[0]) for part in parts]
    if min(np.abs(alone)) < settings.clear_correlation or alone[0] * alone[1] > 0.0:
        return []
    times = streams.time[starts]
    words = (
        f"left and right of the encoders change places at about {times[index]:.0f} s, from then on omega runs the "
        "other way: the order of the joints changed; cut the log there and identify from one part"
    )
    return [Finding("order change", "error", log, words, *cut(times, index))]


def check_counts(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: encoders whose columns are counts; they are removed from `streams`."""
    if streams.twist is None:
        return []
    response = fit_response(streams, streams.command, streams.twist, settings)
    if response is None or response.correlation.max() > settings.clear_correlation:
        return []
    rate = streams.each(
        lambda part: np.gradient(part, streams.dt, axis=0) if len(part) > 1 else part * np.nan, streams.twist
    )
    instead = fit_response(streams, streams.command, rate, settings)
    if instead is None or instead.correlation.min() < settings.clear_correlation:
        return []
    streams.twist = streams.wheels = None
    words = (
        "not the encoders' readings but their changes follow the command: they are running counts; give their columns "
        "`unit: ticks`, and `ticks_per_turn` under 'wheels'"
    )
    return [Finding("running counts", "error", log, words)]


def _each_wheel(log: str, streams: Streams, settings: CheckSettings) -> Finding | None:
    """Return the finding from the response of each wheel to the commands of both sides."""
    assert streams.wheels is not None and streams.twist is not None
    names = _NAMES[streams.wheels.shape[1]]
    present = np.isfinite(streams.wheels).all(axis=1)
    size = np.sqrt(np.mean(streams.wheels[present] ** 2, axis=0)) if present.any() else np.zeros(len(names))
    dead = size < settings.dead_wheel * size.max()
    if dead.any() and not dead.all():
        words = (
            f"the wheel '{names[int(np.argmax(dead))]}' reads nothing while the others turn: mend its "
            "encoder or its column"
        )
        streams.twist = streams.wheels = None
        return Finding("dead wheel", "error", log, words)
    sides = commanded_sides(streams)
    response = None if sides is None else fit_response(streams, sides, streams.wheels, settings)
    if sides is None or response is None or response.correlation.max() < settings.clear_correlation:
        return None
    gain = response.gain.T  # rows: wheels; columns: commanded left, right
    direct = np.array([gain[i, i % 2] for i in range(len(names))])
    crossed = np.array([gain[i, 1 - i % 2] for i in range(len(names))])
    # On a circle the commands of both sides are proportional, so the followed side is ambiguous.
    distinct = not _one_motion(sides, settings)
    if distinct and (np.abs(crossed) > 2 * np.abs(direct)).all():
        if (crossed < 0).all():
            return None  # both sides exchanged and reversed: a robot that drives backwards, told by the sign of v
        streams.twist = streams.twist * [1.0, -1.0]
        words = (
            "each side of the encoders follows what the other was commanded: exchange left and right of "
            "the encoders, or of the commands"
        )
        return Finding("swapped sides", "error", log, words, changes=(MappingChange("encoders", "sides", "exchanged"),))
    strong = (np.abs(direct) > np.abs(crossed)) | (not distinct)
    # If both sides move almost alike, joint gains scatter widely; the gain to a wheel's own side is reliable.
    alone = np.array([_size_of_one(streams, sides[:, i % 2], i, settings) for i in range(len(names))])
    reversed_ = strong & (alone < 0)
    if reversed_.any() and not reversed_.all():
        bad = " and ".join(f"'{name}'" for name, bad in zip(names, reversed_, strict=True) if bad)
        words = f"the wheel {bad} turns against its command, the others do not"
        streams.twist = streams.wheels = None
        turned = tuple(
            MappingChange("encoders", f"{name}.sign", -1) for name, bad in zip(names, reversed_, strict=True) if bad
        )
        return Finding("reversed wheel", "error", log, words, changes=turned)
    # A command in another unit, too, makes sides look uneven: not in the gains of both at once, or else of all wheels.
    lengths, (low, high) = np.abs(alone), settings.gain_of_v
    apart = lengths.min() * settings.uneven_wheels < lengths.max()
    if distinct:
        apart &= np.abs(direct).min() * settings.uneven_wheels < np.abs(direct).max()
    else:
        apart &= ((low < lengths) & (lengths < high)).any()
    if strong.all() and apart:
        odd = int(np.argmax(np.abs(np.log(lengths / np.median(lengths))))) if len(lengths) > 2 else _odd_side(response)
        rest = float(np.median(np.delete(lengths, odd)))
        words = (
            f"the wheel '{names[odd]}' reads {lengths[odd] / rest:.3g} times as fast as the "
            f"other{'s' if len(names) > 2 else ''} for the same "
            "command: give its column the right unit, or check its ticks per turn"
        )
        streams.twist = streams.wheels = None
        return Finding("uneven wheels", "error", log, words)
    return _late_wheel(log, streams, sides, response.lag, settings) if distinct and len(names) == 2 else None


def _late_wheel(log: str, streams: Streams, sides: FloatArray, lag: float, settings: CheckSettings) -> Finding | None:
    """Return the finding for an encoder that answers its side later than the other."""
    assert streams.wheels is not None
    each = [fit_response(streams, sides, wheel, settings, intervals=True, lags=[lag]) for wheel in streams.wheels.T]
    left, right = ((np.nan, np.nan) if how is None else (how.dead_time, how.deviation) for how in each)
    late, deviation = right[0] - left[0], float(np.hypot(*np.nan_to_num([left[1], right[1]])))
    if not abs(late) > max(settings.late_wheel, 3 * deviation):
        return None
    streams.twist = streams.wheels = None
    words = (
        f"the encoder of the {SIDES[int(late > 0)]} side is {abs(late):.2f} +- {1.96 * deviation:.2f} s later than the "
        "other: read both at once, or log the time of each reading"
    )
    return Finding("late wheel", "warning", log, words)


def _size_of_one(streams: Streams, side: FloatArray, wheel: int, settings: CheckSettings) -> float:
    assert streams.wheels is not None
    response = fit_response(streams, side, streams.wheels[:, wheel], settings)
    return np.nan if response is None else response.size


def _one_motion(sides: FloatArray, settings: CheckSettings) -> bool:
    present = sides[np.isfinite(sides).all(axis=1)]
    return bool(abs(np.asarray(np.corrcoef(present.T))[0, 1]) > settings.collinear)


def _odd_side(response: StreamResponse) -> int:
    """Return the side whose gain is further from one."""
    return int(np.argmax(np.abs(np.log(np.abs(np.diag(response.gain))))))


def commanded_sides(streams: Streams) -> FloatArray | None:
    """Compute commanded speeds (N, 2) of the two sides [m/s over the radius], by the track of the log's omega."""
    assert streams.wheels is not None and streams.twist is not None
    present = np.isfinite(streams.wheels).all(axis=1) & np.isfinite(streams.twist).all(axis=1)
    wheels, twist = streams.wheels[present], streams.twist[present]
    mean = wheels.mean(axis=1)
    difference = wheels[:, 1::2].mean(axis=1) - wheels[:, ::2].mean(axis=1)
    if not (mean @ mean > 0 and difference @ difference > 0):
        return None
    # The mapping made v = r mean and omega = r difference / b of these very wheels, so both are exact.
    radius = abs(float(mean @ twist[:, 0]) / float(mean @ mean))
    per_track = abs(float(difference @ twist[:, 1]) / float(difference @ difference))
    if radius == 0 or per_track == 0:
        return None
    half = 0.5 * streams.command[:, 1] / per_track
    middle = streams.command[:, 0] / radius
    return np.column_stack([middle - half, middle + half])


def _sides_of_twist(log: str, streams: Streams, settings: CheckSettings) -> Finding | None:
    """Return the finding for a dead side in a log without wheels, which makes v and omega proportional."""
    assert streams.twist is not None
    present = np.isfinite(streams.twist).all(axis=1) & np.isfinite(streams.command).all(axis=1)
    twist, command = streams.twist[present], streams.command[present]
    if len(twist) < 2 or np.ptp(command, axis=0).min() == 0 or np.ptp(twist, axis=0).min() == 0:
        return None
    together, commanded = (float(np.corrcoef(*part.T)[0, 1]) for part in (twist, command))
    if abs(together) < settings.collinear or abs(commanded) > settings.clear_correlation:
        return None
    side = "left" if together > 0 else "right"
    streams.twist = None
    words = (
        f"v and omega of the encoders are one and the same (correlation {together:.2f}), those of the command "
        "are not: the "
        f"{side} wheel reads nothing; mend its encoder"
    )
    return Finding("dead wheel", "error", log, words)
