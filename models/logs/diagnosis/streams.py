"""The streams of a log side by side, and how one of them answers to another: dead time, lag, gain and shift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import fft
from scipy.ndimage import uniform_filter1d

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.record import BoolArray, Record

COMMAND, ENCODERS, GYRO, POSE = "command", "encoders", "gyro", "pose"
SENSORS = (ENCODERS, GYRO, POSE)
_BLOCKS = 5
"""Number of parts of a log whose scatter gives an interval."""


@dataclass
class Streams:
    """All stretches of one log in sequence, N samples, with NaN between them and for missing readings.

    Rules correct a stream after its fault is reported, so that no fault is reported twice; records are never touched.

    Attributes
    ----------
    dt
        Sample time [s].
    time
        (N,) times on the log's clock [s].
    command, twist
        (N, 2) v [m/s], omega [rad/s] as commanded and of the encoders.
    wheels
        (N, 2) left, right [rad/s], or (N, 4) where each of four wheels is logged.
    yaw_rate, pose
        (N,) [rad/s]; (N, 3) x [m], y [m], theta [rad].
    slices
        Rows of the stretches.
    reach
        Half the window over which poses become speeds [samples].
    commands_wheels
        Whether the log commands wheel speeds, so that v and omega share their columns.
    """

    dt: float
    time: FloatArray
    command: FloatArray
    twist: FloatArray | None
    wheels: FloatArray | None
    yaw_rate: FloatArray | None
    pose: FloatArray | None
    slices: tuple[slice, ...]
    reach: int
    commands_wheels: bool = False

    def channel(self, name: str, channel: int) -> FloatArray | None:
        """Return v (0) or omega (1) of a stream (N,), or None; those of the pose are means over its window."""
        if name == COMMAND:
            return self.command[:, channel]
        if name == ENCODERS:
            return None if self.twist is None else self.twist[:, channel]
        if name == GYRO:
            return self.yaw_rate if channel == 1 else None
        if self.pose is None:
            return None
        step = self.motion()
        along = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * self.pose[:, 2])
        return np.asarray(along.real if channel == 0 else step[:, 2])

    def motion(self) -> FloatArray:
        """Compute rates of x, y, theta of the pose (N, 3) by central differences over its window."""
        assert self.pose is not None
        rates = np.full_like(self.pose, np.nan)
        r = self.reach
        rates[r:-r] = (self.pose[2 * r :] - self.pose[: -2 * r]) / (2 * r * self.dt)
        return rates

    def present(self, channel: int) -> list[str]:
        """List the sensors that measure the channel."""
        return [name for name in SENSORS if self.channel(name, channel) is not None]

    def moving(self, channel: int) -> list[str]:
        """List the sensors that measure the channel itself: all but poses, which are its integral."""
        return [name for name in self.present(channel) if name != POSE]

    def each(self, function: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
        """Apply `function` to each stretch of `values` (N, ...)."""
        result = np.full_like(values, np.nan)
        for part in self.slices:
            result[part] = function(values[part])
        return result

    def delayed(self, values: FloatArray, seconds: float) -> FloatArray:
        """Delay values (N, ...) by `seconds` inside each stretch."""
        count = round(seconds / self.dt)

        def shift(part: FloatArray) -> FloatArray:
            source = np.arange(len(part)) - count
            return np.asarray(part[np.clip(source, 0, len(part) - 1)])

        return self.each(shift, values) if count else values

    def lagged(self, values: FloatArray, lag: float) -> FloatArray:
        """Filter values (N, ...) by two equal lags [s]; each stretch starts settled."""
        if lag == 0:
            return values
        keep = np.exp(-self.dt / lag)

        def low_pass(part: FloatArray) -> FloatArray:
            from scipy.signal import lfilter  # noqa: PLC0415 - loads slowly, and loading a model does not need it

            start = np.where(np.isfinite(part[0]), part[0], 0.0)
            once = lfilter([1 - keep], [1, -keep], _bridged(part) - start, axis=0)
            return np.asarray(lfilter([1 - keep], [1, -keep], once, axis=0) + start)

        return self.each(low_pass, values)

    def smoothed(self, values: FloatArray) -> FloatArray:
        """Average values (N, ...) over the pose's window, to compare them with the pose."""
        known = np.isfinite(values)

        def mean(part: FloatArray) -> FloatArray:
            return np.asarray(uniform_filter1d(part, 2 * self.reach + 1, axis=0, mode="nearest"))

        total, weight = self.each(mean, np.where(known, values, 0.0)), self.each(mean, known.astype(float))
        return np.asarray(np.where(known, total / np.maximum(weight, 1e-9), np.nan))

    def pair(self, first: str, second: str, channel: int) -> tuple[FloatArray, FloatArray]:
        """Return v (0) or omega (1) of two streams, (N,) and (N,); next to the pose the other is averaged, too."""
        a, b = self.channel(first, channel), self.channel(second, channel)
        assert a is not None and b is not None
        if POSE not in (first, second):
            return a, b
        return a if first == POSE else self.smoothed(a), b if second == POSE else self.smoothed(b)

    def inside(self, values: FloatArray, seconds: float) -> FloatArray:
        """Crop `seconds` at both ends of each stretch of values (N, ...), and a third of short ones."""

        def trim(part: FloatArray) -> FloatArray:
            count = min(round(seconds / self.dt), len(part) // 6)
            trimmed = np.full_like(part, np.nan)
            trimmed[count : len(part) - count] = part[count : len(part) - count]
            return trimmed

        return self.each(trim, values)


def _bridged(values: FloatArray) -> FloatArray:
    """Interpolate missing values (n, ...) linearly."""
    if np.isfinite(values).all():
        return values
    rows = np.arange(len(values))
    columns = values.reshape(len(values), -1).T
    filled = [np.interp(rows, rows[k], part[k]) if (k := np.isfinite(part)).any() else part for part in columns]
    return np.column_stack(filled).reshape(values.shape)


def streams_of(records: Sequence[Record], settings: CheckSettings) -> Streams:
    """Build the streams of all records from stretches that are long enough."""
    stride = max(1, round(settings.compared_every / records[0].dt))
    dt = stride * records[0].dt
    counts = [-(-len(record.command) // stride) for record in records]
    space = round((settings.longest_lag + settings.longest_lead) / dt) + 1
    ends = space + np.cumsum([count + space for count in counts])
    total = int(ends[-1])
    slices = tuple(slice(int(end) - space - count, int(end) - space) for end, count in zip(ends, counts, strict=True))

    def gather(field: str) -> FloatArray | None:
        if any(getattr(record, field) is None for record in records):
            return None
        first = getattr(records[0], field)
        values = np.full((total, *first.shape[1:]), np.nan)
        for record, part in zip(records, slices, strict=True):
            values[part] = getattr(record, field)[::stride]
            if (fresh := record.fresh(field)) is not None:
                values[part][~_covered(fresh)[::stride]] = np.nan
        return values

    command = gather("command")
    time = gather("time")
    assert command is not None and time is not None
    # A rounding residue is no command.
    command = np.where(np.nanmax(np.abs(command), axis=0) > settings.least_command, command, 0.0 * command)
    four = gather("wheel_speeds")
    return Streams(
        dt=dt,
        time=time,
        command=command,
        twist=gather("twist"),
        wheels=gather("wheels") if four is None else four,
        yaw_rate=gather("yaw_rate"),
        pose=gather("pose"),
        slices=slices,
        reach=max(1, round(0.5 * settings.pose_window / dt)),
        commands_wheels=all(record.wheel_commands is not None for record in records),
    )


def _covered(fresh: BoolArray) -> BoolArray:
    """Mark samples (K,) on and between readings with usual distances."""
    samples = np.flatnonzero(fresh)
    covered = np.zeros(len(fresh), dtype=bool)
    if len(samples) < 2:
        return fresh
    steps = np.diff(samples)
    near = steps <= 4 * np.median(steps)
    for first, last in zip(samples[:-1][near], samples[1:][near], strict=True):
        covered[first : last + 1] = True
    return covered | fresh


@dataclass(frozen=True)
class StreamResponse:
    """Response of a stream to another.

    Attributes
    ----------
    dead_time, deviation
        Dead time of the response [s], negative where it precedes the command, and its standard deviation from parts of
        the log.
    lag
        Each of the two equal lags after the dead time [s].
    gain
        (c, m) steady gains from c inputs to m outputs.
    correlation
        (m,) of each output with the best combination of the inputs; with one input its sign is that of the gain.
    size
        Response of one output to one input, constant part included: the information of a drive at one speed, whose
        changes contain little.
    """

    dead_time: float
    deviation: float
    lag: float
    gain: FloatArray
    correlation: FloatArray
    size: float

    @property
    def delay(self) -> float:
        """Mean delay, dead time and both lags together [s]."""
        return self.dead_time + 2 * self.lag


def fit_response(
    streams: Streams,
    inputs: FloatArray,
    outputs: FloatArray,
    settings: CheckSettings,
    *,
    intervals: bool = False,
    both_measured: bool = False,
    lags: Sequence[float] | None = None,
) -> StreamResponse | None:
    """Fit the response of `outputs` (N,) or (N, m) to `inputs` (N,) or (N, c); None if either is constant.

    Commands go through two equal lags and a dead time, which may be negative; between two sensors, `both_measured`,
    there is a shift alone, unless `lags` are given. The correlations with all shifts are computed by Fourier
    transforms, over the common samples.
    """
    u, y = inputs.reshape(len(inputs), -1), outputs.reshape(len(outputs), -1)
    if both_measured:
        lags, span = lags or [0.0], (-settings.longest_shift, settings.longest_shift)
    else:
        lags, span = lags or settings.lags, (-settings.longest_lead, settings.longest_lag)
        if not (np.isfinite(u).all(axis=1) & np.isfinite(y).all(axis=1)).any():
            return None
        u, streams = _with_heads(streams, u, y, settings)

    def lagged(lag: float) -> FloatArray:
        behind = streams.lagged(u, lag)
        return streams.inside(behind, settings.longest_shift) if both_measured else behind

    low, high = (round(seconds / streams.dt) for seconds in span)
    best: tuple[float, float, FloatArray] | None = None
    for lag in lags:
        behind = lagged(lag)
        strength = _strength(behind, y, low, high)
        if strength is not None and (best is None or strength.max() > best[0]):
            best = (float(strength.max()), lag, strength)
    if best is None:
        return None
    _, lag, strength = best
    behind = lagged(lag)
    index = int(np.argmax(strength))
    gain, correlation = _regress(behind, y, low + index)
    deviation = np.nan
    if intervals:
        edges = np.linspace(0, len(u), _BLOCKS + 1).astype(int)
        parts = [_strength(behind[a:b], y[a:b], low, high) for a, b in pairwise(edges)]
        peaks = [_peak(part, low) for part in parts if part is not None and part.max() > 0.5 * strength.max()]
        deviation = streams.dt * float(np.std(peaks) / np.sqrt(len(peaks))) if len(peaks) > 1 else np.nan
    before, after = (part[:, 0] for part in paired(behind, y, low + index))
    size = float(before @ after) / max(float(before @ before), 1e-300)
    return StreamResponse(streams.dt * _peak(strength, low), deviation, lag, gain, correlation, size)


def _with_heads(streams: Streams, u: FloatArray, y: FloatArray, settings: CheckSettings) -> tuple[FloatArray, Streams]:
    """Extend inputs by the command before each stretch, which follows from its first readings and the steady gains.

    If every stretch is one step of the command, only the rise at its start determines a dead time.
    """
    space = round(settings.longest_lag / streams.dt)
    gain, _ = _regress(u, y, round(0.5 * settings.longest_lag / streams.dt))
    backwards = np.linalg.pinv(gain)
    u = u.copy()
    low, high = np.nanmin(u, axis=0), np.nanmax(u, axis=0)
    slices = []
    for part in streams.slices:
        first = y[part][: max(3, space // 5)]
        first = first[np.isfinite(first).all(axis=1)][:3]
        before = np.clip(first.mean(axis=0) @ backwards, low, high) if len(first) else u[part.start]
        u[part.start - space : part.start] = before
        slices.append(slice(part.start - space, part.stop))
    return u, replace(streams, slices=tuple(slices))


def _strength(u: FloatArray, y: FloatArray, low: int, high: int) -> FloatArray | None:
    """Compute the share (lags,) of the variance of y (N, m) that u (N, c) explains at each lag, mean over m.

    With one input a negative gain counts only where the positive one explains clearly less: a periodic drive looks
    similar half a period later, inverted.
    """
    present_u, present_y = (np.asarray(np.isfinite(part).all(axis=1)) for part in (u, y))
    if present_u.sum() < 2 or present_y.sum() < 2:
        return None
    a = np.where(present_u[:, None], u - u[present_u].mean(axis=0), 0.0)
    b = np.where(present_y[:, None], y - y[present_y].mean(axis=0), 0.0)
    size = fft.next_fast_len(len(u) + high - low, real=True)
    spectrum_a, spectrum_b = fft.rfft(a, size, axis=0), fft.rfft(b, size, axis=0)
    where = np.arange(low, high + 1) % size
    cross = fft.irfft(np.conj(spectrum_a)[:, :, None] * spectrum_b[:, None, :], size, axis=0)[where]
    pairs = fft.irfft(np.conj(fft.rfft(present_u.astype(float), size)) * fft.rfft(present_y.astype(float), size), size)[
        where
    ]
    inner = a.T @ a / present_u.sum()
    energy = fft.irfft(
        np.conj(fft.rfft(present_u.astype(float), size))[:, None] * fft.rfft(b**2, size, axis=0), size, axis=0
    )[where]
    if (b**2).sum(axis=0).min() <= 0 or np.linalg.matrix_rank(inner) < inner.shape[0]:
        return None
    cross, energy = cross / np.maximum(pairs, 1.0)[:, None, None], energy / np.maximum(pairs, 1.0)[:, None]
    explained = np.einsum("lcm,cd,ldm->lm", cross, np.linalg.inv(inner), cross) / np.maximum(energy, 1e-300)
    strength = explained.mean(axis=1)
    strength[pairs < 0.5 * pairs.max()] = 0.0
    if u.shape[1] == y.shape[1] == 1:
        positive = strength * (cross[:, 0, 0] > 0)
        if positive.max() >= 0.7 * strength.max():
            return np.asarray(positive)
    return np.asarray(strength)


def _peak(strength: FloatArray, low: int) -> float:
    """Find the place of the largest entry [samples], refined by the parabola through its neighbours."""
    index = int(np.argmax(strength))
    if 0 < index < len(strength) - 1:
        left, middle, right = strength[index - 1 : index + 2]
        if left > 0 and right > 0 and left - 2 * middle + right < 0:
            return low + index + 0.5 * float((left - right) / (left - 2 * middle + right))
    return float(low + index)


def paired(u: FloatArray, y: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    """Pair rows of u with rows of y `shift` samples later, where both are finite."""
    if shift >= 0:
        u, y = u[: len(u) - shift], y[shift:]
    else:
        u, y = u[-shift:], y[: len(y) + shift]
    both = np.isfinite(u).reshape(len(u), -1).all(axis=1) & np.isfinite(y).reshape(len(y), -1).all(axis=1)
    return u[both], y[both]


def _regress(u: FloatArray, y: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    u, y = paired(u, y, shift)
    if len(y) < 2:
        return np.zeros((u.shape[1], y.shape[1])), np.zeros(y.shape[1])
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    gain = np.linalg.lstsq(u, y, rcond=None)[0]
    explained = 1 - ((y - u @ gain) ** 2).sum(axis=0) / np.maximum((y**2).sum(axis=0), 1e-300)
    correlation = np.sqrt(np.clip(explained, 0, 1))
    return np.asarray(gain), np.asarray(correlation * (np.sign(gain[0]) if u.shape[1] == 1 else 1.0))


def foresight(streams: Streams, inputs: FloatArray, outputs: FloatArray, settings: CheckSettings) -> float:
    """Compute the share of the variance of `outputs` (N,), unexplained by past commands, that later commands explain.

    The past is a basis of lags and dead times wide enough for any base; no robot can react to the future.
    """
    ahead = streams.inside(outputs, settings.longest_shift)
    past = [streams.delayed(streams.lagged(inputs, lag), late) for lag in settings.lags for late in (0.0, 0.1, 0.3)]
    coming = [streams.delayed(inputs, -early) for early in (0.1, 0.2, 0.3)]
    rows = np.column_stack([ahead, np.ones(len(ahead)), *past, *coming])
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 4 * rows.shape[1]:
        return 0.0
    y, known = rows[:, 0], rows[:, 1 : 2 + len(past)]
    left, less = (y - part @ np.linalg.lstsq(part, y, rcond=None)[0] for part in (known, rows[:, 1:]))
    return float(1 - (less @ less) / max(float(left @ left), 1e-300))
