"""Streams of a log, and the response of one stream to another: dead time, lag, gain and shift."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special
from scipy.ndimage import uniform_filter1d

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.logs.record import BoolArray, Record

COMMAND, ENCODERS, GYRO, POSE = "command", "encoders", "gyro", "pose"
SENSORS = (ENCODERS, GYRO, POSE)
_FIELDS = {ENCODERS: "twist", GYRO: "yaw_rate", POSE: "pose"}
_BLOCKS = 5
"""Number of parts of a log for standard deviations."""
_MIN_SINGULAR = 1e-3
"""Relative singular value below which a short drive does not separate lags and dead times."""


@dataclass
class Streams:
    """Signals of all stretches of one log in sequence, with N samples.

    Samples between stretches and missing readings are NaN. Checks correct the streams after they report a fault, so
    that each fault is reported once; the records of the log are unchanged.

    Attributes
    ----------
    dt
        Sample time [s].
    time
        (N,) times on the log's clock [s].
    command, twist
        (N, 2) v [m/s], omega [rad/s] of the commands and of the encoders.
    wheels
        (N, 2) left, right [rad/s], or (N, 4) if each of four wheels is logged.
    yaw_rate, pose
        (N,) yaw rate of the gyro [rad/s]; (N, 3) x [m], y [m], theta [rad].
    slices
        Rows of the stretches.
    half_window
        Half of the window for the differentiation of poses [samples].
    commands_wheels
        True if the log commands wheel speeds, so that v and omega share their columns.
    mapping
        Mapping of the log.
    """

    dt: float
    time: FloatArray
    command: FloatArray
    twist: FloatArray | None
    wheels: FloatArray | None
    yaw_rate: FloatArray | None
    pose: FloatArray | None
    slices: tuple[slice, ...]
    half_window: int
    commands_wheels: bool = False
    mapping: LogMapping = field(default_factory=LogMapping)

    @property
    def heading_offset(self) -> float:
        """Heading offset of the pose in the mapping [rad]."""
        columns = self.mapping.columns
        return columns.pose.heading_offset if columns and columns.pose else 0.0

    @property
    def has_twist_columns(self) -> bool:
        """True if v and omega of the encoders are read from the log, not computed from wheels."""
        encoders = self.mapping.columns.encoders if self.mapping.columns else None
        return self.wheels is None or encoders is None or encoders.has("v")

    def stated_unit(self, name: str, column: str) -> str:
        """Return the unit of a column of a stream in the mapping; "" if the log has no mapping of columns."""
        return str(getattr(getattr(getattr(self.mapping.columns, name, None), column, None), "unit", ""))

    def channel(self, name: str, channel: int) -> FloatArray | None:
        """Return v (channel 0) or omega (1) of a stream (N,), averaged over the window for poses; None if missing."""
        if name == COMMAND:
            return self.command[:, channel]
        if name == ENCODERS:
            return None if self.twist is None else self.twist[:, channel]
        if name == GYRO:
            return self.yaw_rate if channel == 1 else None
        if self.pose is None:
            return None
        step = self.pose_rates()
        # Velocity in the frame of the robot; the real part is forward.
        velocity = (step[:, 0] + 1j * step[:, 1]) * np.exp(-1j * self.pose[:, 2])
        # On an arc, the chord between two poses is shorter than the path.
        half_turn = np.clip(step[:, 2] * self.half_window * self.dt, -0.5 * np.pi, 0.5 * np.pi)
        return np.asarray(velocity.real / np.sinc(half_turn / np.pi) if channel == 0 else step[:, 2])

    def pose_rates(self) -> FloatArray:
        """Compute rates of x, y, theta of the pose (N, 3) by central differences over its window."""
        assert self.pose is not None
        rates = np.full_like(self.pose, np.nan)
        r = self.half_window
        rates[r:-r] = (self.pose[2 * r :] - self.pose[: -2 * r]) / (2 * r * self.dt)
        return rates

    def sensors(self, channel: int) -> list[str]:
        """List the sensors that measure the channel."""
        return [name for name in SENSORS if self.channel(name, channel) is not None]

    def speed_sensors(self, channel: int) -> list[str]:
        """List the sensors that measure the channel directly, without poses."""
        return [name for name in self.sensors(channel) if name != POSE]

    def map_stretches(self, function: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
        """Apply `function` to each stretch of `values` (N, ...)."""
        result = np.full_like(values, np.nan)
        for part in self.slices:
            result[part] = function(values[part])
        return result

    def delay(self, values: FloatArray, seconds: float) -> FloatArray:
        """Delay values (N, ...) by `seconds` inside each stretch."""
        count = round(seconds / self.dt)

        def delay_part(part: FloatArray) -> FloatArray:
            source = np.arange(len(part)) - count
            return np.asarray(part[np.clip(source, 0, len(part) - 1)])

        return self.map_stretches(delay_part, values) if count else values

    def command_responses(
        self, channel: int, settings: CheckSettings, *, intervals: bool = False
    ) -> dict[str, StreamResponse]:
        """Return the responses of the sensors of a channel to its command; {} for a constant command."""
        responses = {
            name: fit_response(self, *self.pair(COMMAND, name, channel), settings, intervals=intervals)
            for name in self.sensors(channel)
        }
        return {name: response for name, response in responses.items() if response is not None}

    def remove(self, name: str) -> None:
        """Remove a sensor."""
        setattr(self, _FIELDS[name], None)
        if name == ENCODERS:
            self.wheels = None

    def shift(self, name: str, seconds: float) -> None:
        """Delay the readings of a sensor by `seconds`."""
        setattr(self, _FIELDS[name], self.delay(getattr(self, _FIELDS[name]), seconds))

    def low_pass(self, values: FloatArray, lag: float) -> FloatArray:
        """Filter values (N, ...) by two equal first-order lags [s]; each stretch starts in steady state."""
        if lag == 0:
            return values
        pole = np.exp(-self.dt / lag)

        def filter_part(part: FloatArray) -> FloatArray:
            from scipy.signal import lfilter  # noqa: PLC0415 - slow import, not needed to load a model

            start = np.where(np.isfinite(part[0]), part[0], 0.0)
            first_lag = lfilter([1 - pole], [1, -pole], interpolate_missing(part) - start, axis=0)
            return np.asarray(lfilter([1 - pole], [1, -pole], first_lag, axis=0) + start)

        return self.map_stretches(filter_part, values)

    def smooth(self, values: FloatArray) -> FloatArray:
        """Average values (N, ...) over the pose's window for comparison with the pose."""
        is_known = np.isfinite(values)

        def mean(part: FloatArray) -> FloatArray:
            return np.asarray(uniform_filter1d(part, 2 * self.half_window + 1, axis=0, mode="nearest"))

        total, weight = (
            self.map_stretches(mean, np.where(is_known, values, 0.0)),
            self.map_stretches(mean, is_known.astype(float)),
        )
        return np.asarray(np.where(is_known, total / np.maximum(weight, 1e-9), np.nan))

    def pair(self, first: str, second: str, channel: int) -> tuple[FloatArray, FloatArray]:
        """Return v (channel 0) or omega (1) of two streams, (N,) and (N,).

        If one stream is the pose, the other is averaged over the window of the pose.
        """
        a, b = self.channel(first, channel), self.channel(second, channel)
        assert a is not None and b is not None
        if POSE not in (first, second):
            return a, b
        return a if first == POSE else self.smooth(a), b if second == POSE else self.smooth(b)

    def crop(self, values: FloatArray, seconds: float) -> FloatArray:
        """Set `seconds` at each end of each stretch of values (N, ...) to NaN, but at most a sixth of a stretch."""

        def crop_part(part: FloatArray) -> FloatArray:
            count = min(round(seconds / self.dt), len(part) // 6)
            cropped = np.full_like(part, np.nan)
            cropped[count : len(part) - count] = part[count : len(part) - count]
            return cropped

        return self.map_stretches(crop_part, values)


def interpolate_missing(values: FloatArray) -> FloatArray:
    """Interpolate missing values (n, ...) linearly."""
    if np.isfinite(values).all():
        return values
    rows = np.arange(len(values))
    columns = values.reshape(len(values), -1).T
    filled = [np.interp(rows, rows[k], part[k]) if (k := np.isfinite(part)).any() else part for part in columns]
    return np.column_stack(filled).reshape(values.shape)


def streams_of(records: Sequence[Record], settings: CheckSettings) -> Streams:
    """Build the streams of all records."""
    stride = max(1, round(settings.comparison_step / records[0].dt))
    dt = stride * records[0].dt
    counts = [-(-len(record.command) // stride) for record in records]
    # Gaps between stretches are longer than any shift, so that no pair of samples is from two stretches.
    padding = round((settings.max_dead_time + settings.max_lead) / dt) + 1
    ends = padding + np.cumsum([count + padding for count in counts])
    total = int(ends[-1])
    slices = tuple(
        slice(int(end) - padding - count, int(end) - padding) for end, count in zip(ends, counts, strict=True)
    )

    def gather(field: str) -> FloatArray | None:
        if any(getattr(record, field) is None for record in records):
            return None
        first = getattr(records[0], field)
        values = np.full((total, *first.shape[1:]), np.nan)
        for record, part in zip(records, slices, strict=True):
            values[part] = getattr(record, field)[::stride]
            if (fresh := record.fresh(field)) is not None:
                values[part][~_covered_samples(fresh)[::stride]] = np.nan
        return values

    command = gather("command")
    time = gather("time")
    assert command is not None and time is not None
    # Values below the threshold are rounding residues, not commands.
    command = np.where(np.nanmax(np.abs(command), axis=0) > settings.zero_command, command, 0.0 * command)
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
        half_window=max(1, round(0.5 * settings.pose_window / dt)),
        commands_wheels=all(record.wheel_commands is not None for record in records),
    )


def _covered_samples(fresh: BoolArray) -> BoolArray:
    """Mark samples (K,) at readings, and between two readings at the usual distance."""
    samples = np.flatnonzero(fresh)
    covered = np.zeros(len(fresh), dtype=bool)
    if len(samples) < 2:
        return fresh
    steps = np.diff(samples)
    is_near = steps <= 4 * np.median(steps)
    for first, last in zip(samples[:-1][is_near], samples[1:][is_near], strict=True):
        covered[first : last + 1] = True
    return covered | fresh


@dataclass(frozen=True)
class StreamResponse:
    """Response of one stream to another.

    Attributes
    ----------
    dead_time, deviation
        Dead time of the response [s], negative if the response precedes the input, and its standard deviation, from
        the scatter between parts of the log.
    lag
        Time constant of each of two equal lags after the dead time [s].
    gain
        (c, m) steady-state gains from c inputs to m outputs.
    correlation
        (m,) correlation of each output with the best combination of inputs; for one input, with the sign of the gain.
    size
        Ratio of the first output to the first input, including their means, which is also valid for drives at almost
        constant speed.
    """

    dead_time: float
    deviation: float
    lag: float
    gain: FloatArray
    correlation: FloatArray
    size: float

    @property
    def signed_correlation(self) -> float:
        """Correlation of the first output with the sign of `size`; its own sign is random for a rare command."""
        return math.copysign(float(self.correlation[0]), self.size)

    @property
    def delay(self) -> float:
        """Total delay: dead time plus both lags [s]."""
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
    """Fit the response of `outputs` (N,) or (N, m) to `inputs` (N,) or (N, c); return None if either is constant.

    The response to commands has two equal lags and a dead time, which may be negative. Between two sensors
    (`both_measured`), only a shift is fitted unless `lags` are given. The correlations at all shifts are computed by
    Fourier transforms over the common samples. With `intervals`, the standard deviation of the dead time is estimated.
    """
    u, y = inputs.reshape(len(inputs), -1), outputs.reshape(len(outputs), -1)
    if both_measured:
        lags, span = lags or [0.0], (-settings.max_shift, settings.max_shift)
    else:
        lags, span = lags or settings.lags, (-settings.max_lead, settings.max_dead_time)
        if not (np.isfinite(u).all(axis=1) & np.isfinite(y).all(axis=1)).any():
            return None
        u, streams = _with_initial_commands(streams, u, y, settings)

    def filtered_input(lag: float) -> FloatArray:
        values = streams.low_pass(u, lag)
        return streams.crop(values, settings.max_shift) if both_measured else values

    low, high = (round(seconds / streams.dt) for seconds in span)
    best: tuple[float, float, FloatArray] | None = None
    for lag in lags:
        explained_variance = _explained_variance(filtered_input(lag), y, low, high)
        if explained_variance is not None and (best is None or explained_variance.max() > best[0]):
            best = (float(explained_variance.max()), lag, explained_variance)
    if best is None:
        return None
    _, lag, explained_variance = best
    filtered = filtered_input(lag)
    index = int(np.argmax(explained_variance))
    gain, correlation = _regress(filtered, y, low + index)
    deviation = np.nan
    if intervals:
        edges = np.linspace(0, len(u), _BLOCKS + 1).astype(int)
        parts = [_explained_variance(filtered[a:b], y[a:b], low, high) for a, b in pairwise(edges)]
        # A part of the log without excitation has no clear maximum.
        peaks = [_peak(part, low) for part in parts if part is not None and part.max() > 0.5 * explained_variance.max()]
        deviation = streams.dt * float(np.std(peaks) / np.sqrt(len(peaks))) if len(peaks) > 1 else np.nan
    before, after = (part[:, 0] for part in finite_pairs(filtered, y, low + index))
    size = float(before @ after) / max(float(before @ before), 1e-300)
    dead_time = streams.dt * _peak(explained_variance, low)
    return StreamResponse(dead_time, deviation, lag, gain, correlation, size)


def _with_initial_commands(
    streams: Streams, u: FloatArray, y: FloatArray, settings: CheckSettings
) -> tuple[FloatArray, Streams]:
    """Extend the inputs before each stretch by the constant command that explains its first readings.

    The command follows from the steady gains. The extension is needed if each stretch has one step of the command at
    its start, because only this step then determines the dead time.
    """
    padding = round(settings.max_dead_time / streams.dt)
    gain, _ = _regress(u, y, round(0.5 * settings.max_dead_time / streams.dt))
    inverse = np.linalg.pinv(gain)
    u = u.copy()
    low, high = np.nanmin(u, axis=0), np.nanmax(u, axis=0)
    slices = []
    for part in streams.slices:
        first = y[part][: max(3, padding // 5)]
        first = first[np.isfinite(first).all(axis=1)][:3]
        before = np.clip(first.mean(axis=0) @ inverse, low, high) if len(first) else u[part.start]
        u[part.start - padding : part.start] = before
        slices.append(slice(part.start - padding, part.stop))
    return u, replace(streams, slices=tuple(slices))


def _explained_variance(u: FloatArray, y: FloatArray, low: int, high: int) -> FloatArray | None:
    """Compute the share (shifts,) of the variance of y (N, m) that u (N, c) explains at each shift, averaged over m.

    For one input and one output, negative gains are accepted only if positive gains explain clearly less, because a
    periodic drive is similar to its inverse half a period later.
    """
    finite_u, finite_y = (np.asarray(np.isfinite(part).all(axis=1)) for part in (u, y))
    if finite_u.sum() < 2 or finite_y.sum() < 2:
        return None
    a = np.where(finite_u[:, None], u - u[finite_u].mean(axis=0), 0.0)
    b = np.where(finite_y[:, None], y - y[finite_y].mean(axis=0), 0.0)
    # Zero padding prevents the cyclic correlation from wrapping around.
    size = fft.next_fast_len(len(u) + high - low, real=True)
    spectrum_a, spectrum_b = fft.rfft(a, size, axis=0), fft.rfft(b, size, axis=0)
    shifts = np.arange(low, high + 1) % size
    cross = fft.irfft(np.conj(spectrum_a)[:, :, None] * spectrum_b[:, None, :], size, axis=0)[shifts]
    pairs = fft.irfft(np.conj(fft.rfft(finite_u.astype(float), size)) * fft.rfft(finite_y.astype(float), size), size)[
        shifts
    ]
    inner = a.T @ a / finite_u.sum()
    energy = fft.irfft(
        np.conj(fft.rfft(finite_u.astype(float), size))[:, None] * fft.rfft(b**2, size, axis=0), size, axis=0
    )[shifts]
    if (b**2).sum(axis=0).min() <= 0 or np.linalg.matrix_rank(inner) < inner.shape[0]:
        return None
    cross, energy = cross / np.maximum(pairs, 1.0)[:, None, None], energy / np.maximum(pairs, 1.0)[:, None]
    # Share of the variance that the regression on all inputs explains, at each shift.
    explained = np.einsum("lcm,cd,ldm->lm", cross, np.linalg.inv(inner), cross) / np.maximum(energy, 1e-300)
    explained_variance = explained.mean(axis=1)
    # Shifts with few pairs are ignored, because few pairs correlate by chance.
    explained_variance[pairs < 0.5 * pairs.max()] = 0.0
    if u.shape[1] == y.shape[1] == 1:
        positive = explained_variance * (cross[:, 0, 0] > 0)
        if positive.max() >= 0.7 * explained_variance.max():
            return np.asarray(positive)
    return np.asarray(explained_variance)


def _peak(explained_variance: FloatArray, low: int) -> float:
    """Return the position of the maximum [samples], refined by the parabola through its neighbours."""
    index = int(np.argmax(explained_variance))
    if 0 < index < len(explained_variance) - 1:
        left, middle, right = explained_variance[index - 1 : index + 2]
        if left > 0 and right > 0 and left - 2 * middle + right < 0:
            return low + index + 0.5 * float((left - right) / (left - 2 * middle + right))
    return float(low + index)


def finite_pairs(u: FloatArray, y: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    """Return the rows of u and the rows of y `shift` samples later for which both are finite."""
    u, y = (u[: len(u) - shift], y[shift:]) if shift >= 0 else (u[-shift:], y[: len(y) + shift])
    both = np.isfinite(u).reshape(len(u), -1).all(axis=1) & np.isfinite(y).reshape(len(y), -1).all(axis=1)
    return u[both], y[both]


def steady_gain(
    streams: Streams, name: str, channel: int, dead_time: float, settings: CheckSettings, *, has_offset: bool = False
) -> tuple[float, float]:
    """Return the steady-state gain from a command to a sensor, and half of its 95 % interval.

    The gain is the sum of the coefficients of several lags and dead times near `dead_time` [s], so that it does not
    depend on the shape of the response. With `has_offset`, the sensor may have a constant offset.
    """
    command, values = streams.pair(COMMAND, name, channel)
    lagged = [streams.low_pass(command, lag) for lag in settings.lags]
    columns = [streams.delay(part, dead_time + delay) for part in lagged for delay in (-0.1, 0.0, 0.1)]
    regressors = np.column_stack([*columns, *([np.ones(len(values))] if has_offset else [])])
    rows = np.column_stack([streams.crop(regressors, settings.max_dead_time), values])
    rows = rows[np.isfinite(rows).all(axis=1)]
    gain, deviation = jackknife(rows[:, :-1], rows[:, -1], lambda row: float(row[: len(columns)].sum()))
    return gain, -float(special.stdtrit(_BLOCKS - 1, 0.025)) * deviation


def jackknife(
    rows: NDArray[Any], values: NDArray[Any], quantity: Callable[[NDArray[Any]], float]
) -> tuple[float, float]:
    """Return a quantity of the least-squares coefficients (k,) of rows (n, k), and its standard deviation.

    The deviation is estimated by omission of one part of the log after the other, so it includes correlated errors.
    """
    parts = [np.empty(0, dtype=int), *np.array_split(np.arange(len(rows)), _BLOCKS)]
    whole, *quantities = (
        quantity(np.linalg.lstsq(np.delete(rows, part, axis=0), np.delete(values, part), rcond=_MIN_SINGULAR)[0])
        for part in parts
    )
    return whole, float(np.sqrt(_BLOCKS - 1) * np.std(quantities))


def _regress(u: FloatArray, y: FloatArray, shift: int) -> tuple[FloatArray, FloatArray]:
    u, y = finite_pairs(u, y, shift)
    if len(y) < 2:
        return np.zeros((u.shape[1], y.shape[1])), np.zeros(y.shape[1])
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    gain = np.linalg.lstsq(u, y, rcond=None)[0]
    explained = 1 - ((y - u @ gain) ** 2).sum(axis=0) / np.maximum((y**2).sum(axis=0), 1e-300)
    correlation = np.sqrt(np.clip(explained, 0, 1))
    return np.asarray(gain), np.asarray(correlation * (np.sign(gain[0]) if u.shape[1] == 1 else 1.0))


def past_commands(streams: Streams, command: FloatArray, settings: CheckSettings) -> FloatArray:
    """Return a command (N,) with lags and dead times that cover all bases (N, columns)."""
    lagged = [streams.low_pass(command, lag) for lag in settings.lags]
    return np.column_stack([streams.delay(part, delay) for part in lagged for delay in (0.0, 0.1, 0.3)])


def residual_variance(rows: NDArray[Any], values: NDArray[Any]) -> float:
    """Return the variance of values (n,) that a regression on rows (n, k) does not explain."""
    return float(np.mean(np.abs(values - rows @ np.linalg.lstsq(rows, values, rcond=None)[0]) ** 2))


def explained_by_future(streams: Streams, inputs: FloatArray, outputs: FloatArray, settings: CheckSettings) -> float:
    """Compute the share of the residual variance of `outputs` (N,) that later commands explain.

    The residual is that of a regression on past commands, with lags and dead times that cover all bases. For a causal
    robot the share is small.
    """
    cropped = streams.crop(outputs, settings.max_shift)
    past = past_commands(streams, inputs, settings)
    future = [streams.delay(inputs, -lead) for lead in (0.1, 0.2, 0.3)]
    rows = np.column_stack([cropped, np.ones(len(cropped)), past, *future])
    rows = rows[np.isfinite(rows).all(axis=1)]
    # With few samples per coefficient, later commands explain the rest by chance.
    if len(rows) < 4 * rows.shape[1]:
        return 0.0
    y, past_rows = rows[:, 0], rows[:, 1 : 2 + past.shape[1]]
    before, after = (residual_variance(part, y) for part in (past_rows, rows[:, 1:]))
    return 1 - after / max(before, 1e-300)
