"""Whether the records of a log can teach anything: commands that excite, sensors that read, responses that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.mapping import MIXED_UP
from diffdrive_mpc.models.logs.record import BoolArray, Finding, Record
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = {"v": "m/s", "omega": "rad/s"}
_LEAST_LEFT = 0.5
"""Of the readings, at a lag that counts."""
_REMEDY = "drive steps of both signs in v and in omega, each for a second or more"
_SENSORS = {
    "encoders": ("twist", "fresh_twist", (0, 1)),
    "gyro": ("yaw_rate", "fresh_yaw_rate", (1,)),
    "pose": ("pose", "fresh_pose", (0, 1)),
}
"""Field, mask, and the channels of the command that the sensor should answer to."""


def check_commands(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Findings about commands that never or hardly change, that change together, or that rest at a limit."""
    commands = np.concatenate([record.command for record in records])
    still = [bool(np.ptp(column) == 0) for column in commands.T]
    if all(still):
        v, omega = commands[0]
        words = f"the command never changes (v {v:g} m/s, omega {omega:g} rad/s), so it excites nothing; {_REMEDY}"
        return [Finding("constant input", "error", log, words)]
    findings = []
    for j, channel in enumerate(CHANNELS):
        if still[j]:
            words = (
                f"{channel} is always commanded {commands[0, j]:g} {_UNITS[channel]}: nothing can be learned about it"
            )
            findings.append(Finding("constant input", "warning", log, f"{words}; {_REMEDY}"))
            continue
        largest = float(np.abs(commands[:, j]).max())
        levels = [np.round(record.command[:, j] / (settings.significant_change * largest)) for record in records]
        changes = sum(int(np.count_nonzero(np.diff(level))) for level in levels)
        if changes < settings.fewest_changes:
            words = (
                f"the command of {channel} changes {changes} times, too few to tell gain, lag and dead time; {_REMEDY}"
            )
            findings.append(Finding("little excitation", "warning", log, words))
        findings += _saturated(log, records, j, settings)
    if not any(still):
        together = float(np.corrcoef(commands.T)[0, 1])
        if abs(together) > settings.collinear:
            words = (
                f"v and omega are commanded in step (correlation {together:.2f}), so their effects cannot be told apart"
            )
            findings.append(Finding("little excitation", "warning", log, f"{words}; {_REMEDY}"))
    return findings


def _saturated(log: str, records: Sequence[Record], j: int, settings: CheckSettings) -> list[Finding]:
    """A finding where channel `j` rests at its largest value for much of the time, though it takes many others."""
    size = np.abs(np.concatenate([record.command[:, j] for record in records]))
    largest = float(size.max())
    share = float(np.mean(size >= 0.999 * largest))
    if share <= settings.saturated_share or len(np.unique(size)) < settings.saturated_levels:
        return []
    time = np.concatenate([record.time for record in records])
    place = f"{log}, first at {time[np.argmax(size >= 0.999 * largest)]:.1f} s"
    words = (
        f"the command of {CHANNELS[j]} rests at its limit of {largest:.3g} {_UNITS[CHANNELS[j]]} in "
        f"{100 * share:.0f} % of the samples; make sure that the log holds what was sent after limiting"
    )
    return [Finding("saturation", "warning", place, words)]


@dataclass(frozen=True)
class MeasuredChannel:
    """One measured channel over several records.

    Attributes
    ----------
    sensor
        "encoders", "gyro" or "pose".
    channel
        0 for v, 1 for omega.
    measured
        One (K,) array per record in SI units; NaN where there is no reading.
    """

    sensor: str
    channel: int
    measured: tuple[FloatArray, ...]

    @property
    def changes(self) -> bool:
        """Whether any two readings differ."""
        readings = np.concatenate(self.measured)
        readings = readings[np.isfinite(readings)]
        return len(readings) > 1 and bool(np.ptp(readings) > 0)


def largest_command(records: Sequence[Record]) -> FloatArray:
    """(2,) largest |v| [m/s] and |omega| [rad/s] that are commanded anywhere."""
    return np.asarray(np.max([np.abs(record.command).max(axis=0) for record in records], axis=0))


def responses(records: Sequence[Record], pose_window: float) -> list[MeasuredChannel]:
    """All channels that the records hold; the pose's as its mean speeds over `pose_window` [s]."""
    found = []
    for channel in (0, 1):
        if all(record.twist is not None for record in records):
            found.append(MeasuredChannel("encoders", channel, tuple(_twist(record)[:, channel] for record in records)))
        if channel == 1 and all(record.yaw_rate is not None for record in records):
            found.append(MeasuredChannel("gyro", channel, tuple(_yaw_rate(record) for record in records)))
        if all(record.pose is not None for record in records) and _long_enough(records, pose_window):
            speeds = tuple(pose_speeds(record, pose_window)[:, channel] for record in records)
            found.append(MeasuredChannel("pose", channel, speeds))
    return found


def pose_speeds(record: Record, window: float) -> FloatArray:
    """(K, 2) v [m/s] and omega [rad/s] of the pose, as central differences over `window` [s]; NaN at the ends."""
    assert record.pose is not None
    reach = max(1, round(0.5 * window / record.dt))
    speeds = np.full((len(record.pose), 2), np.nan)
    if len(record.pose) > 2 * reach:
        dx, dy, turn = (record.pose[2 * reach :] - record.pose[: -2 * reach]).T / (2 * reach * record.dt)
        theta = record.pose[reach:-reach, 2]
        speeds[reach:-reach] = np.column_stack([np.cos(theta) * dx + np.sin(theta) * dy, turn])
    return speeds


def _long_enough(records: Sequence[Record], window: float) -> bool:
    """Whether any record holds two windows: in a shorter one poses hardly tell speeds, and that is no fault."""
    return any(record.end - record.start >= 2 * window for record in records)


def _twist(record: Record) -> FloatArray:
    assert record.twist is not None and record.fresh_twist is not None
    return np.where(record.fresh_twist[:, None], record.twist, np.nan)


def _yaw_rate(record: Record) -> FloatArray:
    assert record.yaw_rate is not None and record.fresh_yaw_rate is not None
    return np.where(record.fresh_yaw_rate, record.yaw_rate, np.nan)


def check_sensors(records: Sequence[Record], settings: CheckSettings) -> tuple[list[Record], list[Finding]]:
    """Find readings that stay the same bit for bit although the command says otherwise, and mark them as not fresh.

    A reading is stuck if the command changed and, `stuck_time` later, it still had not; or if a robot that should
    move reads zero, or one and the same pose, for `stuck_time`. A robot that was held (an emergency stop, a blocked
    wheel) looks the same, and is no less useless for a model.
    """
    largest = largest_command(records)
    checked, findings = [], []
    for record in records:
        changes: dict[str, BoolArray] = {}
        for sensor, (field, mask, channels) in _SENSORS.items():
            values, fresh = getattr(record, field), getattr(record, mask)
            if values is None:
                continue
            asked = np.divide(record.command, largest, out=np.zeros_like(record.command), where=largest > 0)
            for first, last in _stuck(values, fresh, asked[:, channels], sensor == "pose", record.dt, settings):
                changes.setdefault(mask, fresh.copy())[first + 1 : last + 1] = False
                start, end = float(record.time[first]), float(record.time[last])
                words = f"the {sensor} read the same for {end - start:.1f} s while the robot should move; left out"
                place = f"{record.name.split(',')[0]}, {start:.1f} to {end:.1f} s"
                findings.append(Finding("stuck sensor", "warning", place, words, (start, end)))
        checked.append(replace(record, **changes))  # type: ignore[arg-type]  # masks only
    return checked, findings


def _stuck(
    values: FloatArray, fresh: BoolArray, asked: FloatArray, is_pose: bool, dt: float, settings: CheckSettings
) -> list[tuple[int, int]]:
    """First and last sample of each run of equal readings that the commands, as shares of the largest, contradict."""
    samples = np.flatnonzero(fresh)
    if not len(samples):
        return []
    readings = values[samples].reshape(len(samples), -1)
    edges = np.flatnonzero((np.diff(readings, axis=0) != 0).any(axis=1))
    patience = int(np.ceil(settings.stuck_time / dt))
    runs = []
    for a, b in zip([0, *(edges + 1)], [*edges, len(samples) - 1], strict=True):
        first, last = int(samples[a]), int(samples[b])
        if last - first < patience:
            continue
        commands = asked[first : last - patience + 1]
        at_rest = is_pose or not readings[a].any()
        moving = (np.abs(asked[first : last + 1]) > settings.stuck_command).any(axis=1).all()
        changed = np.ptp(commands, axis=0).max() > settings.stuck_command
        if changed or (at_rest and moving):
            runs.append((first, last))
    return runs


def check_responses(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Findings about measured channels that run against the command, do not follow it, or have an impossible gain."""
    findings = []
    for response in responses(records, settings.pose_window):
        commands = [record.command[:, response.channel] for record in records]
        if np.ptp(np.concatenate(commands)) > 0:
            lags = _lags(records[0].dt, settings.longest_lag)
            correlation, gain = follow(commands, response.measured, lags)
            # Where it changes and the command does not, nothing can be said: the log is too short for that.
            if np.isnan(correlation) and response.changes:
                continue
            findings += _judge(log, response, correlation, gain, settings)
    return findings


def follow(commands: Sequence[FloatArray], measured: Sequence[FloatArray], lags: Sequence[int]) -> tuple[float, float]:
    """How a response (K,) per record follows its command (K,), at the lag [samples] where it does so most.

    Returns
    -------
    tuple
        Correlation and gain (slope of the response over the command); NaN where at no lag both change.
    """
    best = (float("nan"), float("nan"))
    readings = sum(int(np.isfinite(response).sum()) for response in measured)
    for lag in lags:
        u = np.concatenate([command[: max(len(command) - lag, 0)] for command in commands])  # or shorter than the lag
        y = np.concatenate([response[lag:] for response in measured])
        u, y = u[np.isfinite(y)], y[np.isfinite(y)]
        # What is left of a short log at a long lag is too little to go by.
        if len(y) < max(2.0, _LEAST_LEFT * readings) or np.ptp(y) == 0 or np.ptp(u) == 0:
            continue
        covariance = np.cov(u, y)
        correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
        if not abs(correlation) <= abs(best[0]):
            best = (correlation, float(covariance[0, 1] / covariance[0, 0]))
    return best


def _lags(dt: float, longest: float) -> list[int]:
    return sorted({round(lag / dt) for lag in np.linspace(0.0, longest, 21)})


def _judge(
    log: str, response: MeasuredChannel, correlation: float, gain: float, settings: CheckSettings
) -> list[Finding]:
    what = f"{CHANNELS[response.channel]} of the {response.sensor}"
    if np.isnan(correlation):
        words = f"{what} never changes although it is commanded to; is it the right column, and the sensor connected?"
        return [Finding("no response", "error", log, words)]
    findings = []
    if correlation < settings.wrong_sign:
        words = f"{what} runs against the command (correlation {correlation:.2f}); give it `sign: -1` in the mapping"
        findings.append(Finding("wrong sign", "error", log, words))
    elif abs(correlation) < settings.weak_correlation or correlation < 0:
        words = (
            f"{what} hardly follows the command (correlation {correlation:.2f}); is it the right column, and did the "
            "robot obey these commands?"
        )
        return [Finding("weak response", "warning", log, words)]
    size = abs(gain)
    if not settings.smallest_gain <= size <= settings.largest_gain:
        factors = {name: factor if size > 1 else 1 / factor for name, factor in MIXED_UP.items()}
        nearest = min(factors, key=lambda name: abs(np.log(size / factors[name])))
        words = (
            f"{what} is {size:.3g} times the command; were {nearest} (a factor of {factors[nearest]:.3g}) mixed up? "
            "Check the units in the mapping"
        )
        hopeless = not 1 / settings.hopeless_gain <= size <= settings.hopeless_gain
        findings.append(Finding("wrong unit", "error" if hopeless else "warning", log, words))
    return findings
