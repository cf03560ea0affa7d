"""Signs, units and axes: streams that measure the same thing must agree on it, and the odd one out is named."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.limits import within_limits
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, ENCODERS, GYRO, POSE, Streams, fit_response
from diffdrive_mpc.models.logs.mapping import FACTORS, FOUR_WHEELS, SIDES
from diffdrive_mpc.models.logs.record import Finding, MappingChange
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS: dict[tuple[str, int], tuple[str, ...]] = {
    (COMMAND, 0): ("mm/s", "cm/s", "km/h"),
    (COMMAND, 1): ("deg/s", "rpm", "rev/s"),
    (ENCODERS, 0): ("rpm", "deg/s", "rev/s", "mm/s", "cm/s", "km/h"),
    (ENCODERS, 1): ("deg/s", "rpm", "rev/s"),
    (GYRO, 1): ("deg/s", "rpm", "rev/s"),
    (POSE, 0): ("mm", "cm"),
    (POSE, 1): ("deg",),
}
"""Units that the columns of a stream may be in, by stream and channel."""
_ALIKE = 0.1
"""Between the logarithms of two units' factors: on a wheel of 0.16 m m/s and rev/s are the same."""
_WHAT = {
    (COMMAND, 0): "v of the command",
    (COMMAND, 1): "omega of the command",
    (ENCODERS, 0): "v of the encoders",
    (ENCODERS, 1): "omega of the encoders",
    (GYRO, 1): "omega of the gyro",
    (POSE, 0): "v of the pose",
    (POSE, 1): "omega of the pose",
}


@dataclass(frozen=True)
class _Vote:
    """Relation of a stream to the command: ratio of magnitudes, and signed correlation at the best lag.

    At one speed, changes alone do not determine the sign: there are few.
    """

    size: float
    correlation: float


def check_axes(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about contradictions between axes, heading and motion of poses, corrected in `streams`."""
    if streams.pose is None:
        return []
    votes = _votes(streams, 1, settings)
    turned = POSE in votes and votes[POSE].correlation < settings.wrong_sign
    direction = np.sign(streams.delayed(streams.lagged(streams.command[:, 0], 0.1), 0.2))
    step = streams.motion()
    motion, heading = step[:, 0] + 1j * step[:, 1], np.exp(-1j * streams.pose[:, 2])
    used = np.isfinite(motion) & np.isfinite(heading) & np.isfinite(direction)
    size = float((np.abs(motion[used]) * np.abs(direction[used])).sum())
    if not used.any() or size == 0 or np.ptp(streams.command[used, 0]) == 0:
        return []
    along = complex((motion * heading * direction)[used].sum()) / size
    across = complex((np.conj(motion) * heading * direction)[used].sum()) / size
    if abs(across) < settings.clear_correlation or abs(across) < 1.5 * abs(along):
        return _turned(log, streams, settings)
    if turned:
        streams.pose = streams.pose * [1.0, 1.0, -1.0]
        words = "omega of the pose runs against the command and against its own path"
        return [Finding("wrong sign", "error", log, words, changes=(MappingChange(POSE, "theta.sign", -1),))]
    angle = math.degrees(np.angle(across))
    if abs(abs(angle) - 90) < 30:
        streams.pose = streams.pose[:, [1, 0, 2]]
        words = "the pose moves as if x and y were exchanged: exchange the columns of 'x' and 'y' of the pose"
        change = MappingChange(POSE, "axes", "exchanged")
    else:
        axis = 1 if abs(angle) < 45 else 0
        streams.pose = streams.pose * np.where(np.arange(3) == axis, -1.0, 1.0)
        name = "xy"[axis]
        words = "the path of the pose is the mirror image of its own heading"
        change = MappingChange(POSE, f"{name}.sign", -1)
    return [Finding("mirrored pose", "error", log, words, changes=(change,))]


def _turned(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return the finding for a constant angle between the heading of the pose and the direction of motion.

    A pose point off the centre of rotation moves sideways with omega, and this part is attributed to omega.
    """
    assert streams.pose is not None
    step = streams.motion()
    moved = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * streams.pose[:, 2])
    v = streams.smoothed(streams.delayed(streams.lagged(streams.command[:, 0], 0.1), 0.2))
    used = np.isfinite(moved) & np.isfinite(v) & np.isfinite(step[:, 2])
    rows, moved = np.column_stack([v, step[:, 2]])[used].astype(complex), moved[used]
    commands = streams.command[used]
    if np.ptp(commands, axis=0).min() > 0 and abs(np.corrcoef(commands.T)[0, 1]) > settings.collinear:
        return []  # which of the two moves it sideways cannot be told
    by, *_ = np.linalg.lstsq(rows, moved, rcond=None)
    explained = 1 - np.sum(np.abs(moved - rows @ by) ** 2) / max(float(np.sum(np.abs(moved) ** 2)), 1e-300)
    offset = -float(np.angle(by[0]))
    # Half a turn is a wrong sign.
    if explained < settings.clear_correlation**2 or not settings.turned_pose < abs(offset) < np.pi - 0.5:
        return []
    streams.pose = streams.pose - [0.0, 0.0, offset]
    words = (
        f"the pose moves at {math.degrees(-offset):.0f} deg to its own heading: its frame is turned against the robot"
    )
    change = MappingChange(POSE, "heading_offset", round(offset, 4))
    return [Finding("turned pose", "warning", log, words, changes=(change,))]


def _all_swapped(log: str, votes: dict[str, _Vote], streams: Streams) -> Finding | None:
    """Return the finding for gyro and pose that turn against commands and encoders, corrected in `streams`."""
    body, sides = [name for name in (GYRO, POSE) if name in votes], votes.get(ENCODERS)
    if len(body) < 2 or sides is None or streams.wheels is None or sides.correlation < 0:
        return None
    if any(votes[name].correlation > 0 for name in body):
        return None
    for name in (COMMAND, ENCODERS):
        _turn(streams, name, 1)
    words = (
        "gyro and pose turn against the command and the encoders, which agree: exchange left and right of both, "
        "of the encoders and of the commands"
    )
    command = (
        MappingChange(COMMAND, "sides", "exchanged") if streams.commands_wheels else _signs(COMMAND, 1, streams)[0]
    )
    changes = (MappingChange(ENCODERS, "sides", "exchanged"), command)
    return Finding("swapped sides", "error", log, words, changes=changes)


def check_signs(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about unresponsive or inverted streams, which are corrected in `streams` or removed."""
    findings = []
    for channel in (0, 1):
        votes = _votes(streams, channel, settings)
        if not votes:
            continue
        best = max(abs(vote.correlation) for vote in votes.values())
        for name, vote in list(votes.items()):
            if (
                abs(vote.correlation) < settings.weak_correlation
                or -settings.weak_correlation > vote.correlation > settings.wrong_sign
            ):
                findings.append(_weak(log, name, channel, vote, best, settings))
                _take_out(streams, name)
                del votes[name]
        if channel == 1 and (swapped := _all_swapped(log, votes, streams)):
            findings.append(swapped)
            continue
        against = [name for name, vote in votes.items() if vote.correlation < 0]
        if not against:
            continue
        most = len(against) > 1 and len(against) == len(votes)
        for name in [COMMAND] if most else against:
            signal = _WHAT[name, channel]
            reference = "all sensors" if most else "the command"
            both = name == ENCODERS and channel == 0 and streams.wheels is not None
            worst = min(vote.correlation for vote in votes.values()) if most else votes[name].correlation
            words = f"{signal} runs against {reference} (correlation {worst:.2f})"
            turned = _signs(name, channel, streams)
            _turn(streams, name, channel)
            if both and ENCODERS in (others := _votes(streams, 1, settings)) and others[ENCODERS].correlation < 0:
                _turn(streams, ENCODERS, 1)  # wheels that run backwards turn both
                turned += _signs(ENCODERS, 1, streams)
            findings.append(Finding("wrong sign", "error", log, words, changes=turned))
    return findings


def _weak(log: str, name: str, channel: int, vote: _Vote, best: float, settings: CheckSettings) -> Finding:
    words = (
        f"{_WHAT[name, channel]} hardly follows the command (correlation {vote.correlation:.2f}); is it the "
        "right column, and "
        "did the robot obey these commands?"
    )
    # If another sensor follows, this one is wrong; poses are not used for the model.
    lost = name != POSE and best > settings.clear_correlation
    return Finding("weak response", "error" if lost else "warning", log, words)


def check_units(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about streams whose magnitude contradicts the others, corrected in `streams`."""
    findings: list[Finding] = []
    for channel in (0, 1):
        low, high = settings.gain_of_v if channel == 0 else settings.gain_of_omega
        sizes = _sizes(streams, channel, settings)
        if len(sizes) > 1 and _odd_one_out(sizes, low, high) is not None:
            streams.command = within_limits(streams, channel, settings).command
            sizes = _sizes(streams, channel, settings)
        while len(sizes) > 1:
            odd = _odd_one_out(sizes, low, high)
            if odd is None:
                break
            if odd == ENCODERS and len(sizes) == 2 and streams.commands_wheels and _command_is_odd(streams, settings):
                odd = COMMAND
            # Gyro and pose measure the same body; wheels follow commands, even if the robot skids.
            partner = {GYRO: POSE, POSE: GYRO, COMMAND: ENCODERS}.get(odd, "") if channel == 1 else ""
            others = [partner] if partner in sizes else [name for name in sizes if name != odd]
            rest = float(np.exp(np.median([np.log(sizes[name]) for name in others])))
            ratio = sizes.pop(odd) / rest
            skids = channel == 1 and odd in (GYRO, POSE) and partner not in sizes
            findings.append(_unit(log, odd, channel, ratio, skids, streams, settings))
            _scale(streams, odd, channel, 1 / ratio)
    return findings


def _sizes(streams: Streams, channel: int, settings: CheckSettings) -> dict[str, float]:
    """Return the size of each stream of a channel over that of the command."""
    votes = _votes(streams, channel, settings)
    return {COMMAND: 1.0} | {name: abs(vote.size) for name, vote in votes.items() if vote.size}


def _command_is_odd(streams: Streams, settings: CheckSettings) -> bool:
    """Return True if omega shows that of commanded and measured wheels the commands are in another unit."""
    sizes = _sizes(streams, 1, settings)
    return len(sizes) > 2 and _odd_one_out(sizes, *settings.gain_of_omega) == COMMAND


def _odd_one_out(sizes: dict[str, float], low: float, high: float) -> str | None:
    """Find the stream furthest from the others' median beyond what a robot explains; of two, the sensor."""
    logs = {name: math.log(size) for name, size in sizes.items()}
    worst = None
    for name in sizes:
        others = [value for log_name, value in logs.items() if log_name != name]
        apart = logs[name] - float(np.median(others))
        bound = (low, high) if name not in (COMMAND, ENCODERS) else (1 / high, 1 / low)
        outside = not math.log(bound[0]) <= apart <= math.log(bound[1])
        # The command is last, so that of two that disagree the sensor is named.
        rank = (abs(apart) if outside else -1.0, name != COMMAND)
        if outside and (worst is None or rank > worst[0]):
            worst = (rank, name)
    return None if worst is None else worst[1]


def _unit(
    log: str, name: str, channel: int, ratio: float, skids: bool, streams: Streams, settings: CheckSettings
) -> Finding:
    signal = _WHAT[name, channel]
    factors = {unit: 1 / FACTORS[unit] for unit in _UNITS[name, channel]}
    radius = _radius(streams)
    wheels = (name == ENCODERS and streams.wheels is not None) or (name == COMMAND and streams.commands_wheels)
    if wheels and radius is not None:
        factors = {unit: 1 / FACTORS[unit] for unit in ("rpm", "deg/s", "rev/s")} | {"m/s": radius}
    # A body on skidding wheels turns less than the wheels indicate.
    usual = settings.usual_skid if skids else 1.0
    apart = {unit: abs(math.log(ratio / (usual * factor))) for unit, factor in factors.items()}
    # A wrong declaration of that unit for data in SI has the inverse effect.
    apart |= {
        f"{_si(unit)} (and not {unit})": abs(math.log(ratio * factor / usual))
        for unit, factor in factors.items()
        if unit != "rev/s"
    }
    unit = min(apart, key=apart.__getitem__)
    alike = [alternative for alternative in apart if apart[alternative] < apart[unit] + _ALIKE]
    changes: tuple[MappingChange, ...] = ()
    close = settings.unit_tolerance * (3 if skids else 1 + channel)
    against = "what the others say"
    if apart[unit] < close:
        remedy = f"its column is in {unit}"
        if len(alike) == 1:
            changes = tuple(
                MappingChange(name, f"{column}.unit", unit.split()[0]) for column in _columns(name, channel, streams)
            )
        else:
            units = " or ".join(f"`unit: {alternative}`" for alternative in alike)
            remedy = f"its column has {units}, which of them the log does not tell"
    elif (name == ENCODERS or wheels) and ratio > settings.most_unit_gain:
        remedy = "its columns may count ticks: `unit: ticks/s` or `unit: ticks` in the mapping, and `ticks_per_turn`"
    else:
        remedy = "no unit of the mapping explains it; check its column, its unit and the lengths under 'wheels'"
    words = f"{signal} is {ratio:.3g} times {against}; {remedy}"
    return Finding("wrong unit", "error", log, words, changes=changes)


def _columns(name: str, channel: int, streams: Streams) -> tuple[str, ...]:
    """Return the keys of the mapping for the columns of a channel."""
    if name == COMMAND:
        return SIDES if streams.commands_wheels else (CHANNELS[channel],)
    if name == ENCODERS:
        if streams.wheels is None:
            return (CHANNELS[channel],)
        return SIDES if streams.wheels.shape[1] == len(SIDES) else FOUR_WHEELS
    if name == GYRO:
        return ("yaw_rate",)
    return ("x", "y") if channel == 0 else ("theta",)


def _signs(name: str, channel: int, streams: Streams) -> tuple[MappingChange, ...]:
    """Return the changes that invert a channel; for omega of wheels, the mapping exchanges the sides."""
    columns = _columns(name, channel, streams)
    if columns[0] in (*SIDES, *FOUR_WHEELS):
        columns = (CHANNELS[channel],)
    return tuple(MappingChange(name, f"{column}.sign", -1) for column in columns)


def _si(unit: str) -> str:
    return {"mm": "m", "cm": "m", "deg": "rad", "mm/s": "m/s", "cm/s": "m/s", "km/h": "m/s", "m/s": "rad/s"}.get(
        unit, "rad/s"
    )


def _radius(streams: Streams) -> float | None:
    """Return the radius by which the mapping converted wheel speeds to v [m]; None without wheels."""
    if streams.wheels is None or streams.twist is None:
        return None
    mean, v = streams.wheels.mean(axis=1), streams.twist[:, 0]
    both = np.isfinite(mean) & np.isfinite(v)
    size = float(mean[both] @ mean[both])
    return abs(float(mean[both] @ v[both])) / size if size > 0 else None


def _votes(streams: Streams, channel: int, settings: CheckSettings) -> dict[str, _Vote]:
    """Compute the relation of each sensor of the channel to the command; empty for a constant command."""
    votes = {}
    for name in streams.present(channel):
        response = fit_response(streams, *streams.pair(COMMAND, name, channel), settings)
        if response is not None:
            votes[name] = _Vote(response.size, math.copysign(float(response.correlation[0]), response.size))
    return votes


def _take_out(streams: Streams, name: str) -> None:
    if name == ENCODERS:
        streams.twist = streams.wheels = None
    elif name == GYRO:
        streams.yaw_rate = None
    elif name == POSE:
        streams.pose = None


def _turn(streams: Streams, name: str, channel: int) -> None:
    _scale(streams, name, channel, -1.0)


def _scale(streams: Streams, name: str, channel: int, factor: float) -> None:
    """Multiply one channel of a stream, or the whole stream if its channels share their columns."""
    columns = np.where(np.arange(2) == channel, factor, 1.0)
    if name == COMMAND:
        shared = streams.commands_wheels and factor > 0
        streams.command = streams.command * (factor if shared else columns)
    elif name == ENCODERS and streams.twist is not None:
        shared = streams.wheels is not None and factor > 0
        streams.twist = streams.twist * (factor if shared else columns)
    elif name == GYRO and streams.yaw_rate is not None:
        streams.yaw_rate = streams.yaw_rate * factor
    elif name == POSE and streams.pose is not None:
        streams.pose = streams.pose * ([factor, factor, 1.0] if channel == 0 else [1.0, 1.0, factor])


def check_presence(log: str, streams: Streams) -> list[Finding]:
    """Return findings about sensors that never change under changing commands; remove them from `streams`."""
    findings = []
    for channel in (0, 1):
        command = streams.command[:, channel]
        if np.nanmax(command) == np.nanmin(command):
            continue
        for name in streams.present(channel):
            # A stretch too short for the pose's window has no speeds, and that is no fault of the pose.
            values = streams.channel(name, channel)
            if name == POSE and streams.pose is not None:
                values = streams.pose[:, :2] if channel == 0 else streams.pose[:, 2]
            assert values is not None
            readings: FloatArray = values[np.isfinite(values)]
            if (
                len(readings)
                and np.ptp(values[np.isfinite(values).reshape(len(values), -1).all(axis=1)], axis=0).max() > 0
            ):
                continue
            words = (
                f"{CHANNELS[channel]} of the {name} never changes although it is commanded to; is it the "
                "right column, and the "
                "sensor connected?"
            )
            findings.append(Finding("no response", "error", log, words))
            _take_out(streams, name)
    return findings
