"""Common representation of logs: evenly sampled stretches in SI units, and findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.doubt import VERDICTS, DoubtRelevance
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import escape

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.diagnosis.streams import Streams

BoolArray = NDArray[np.bool_]
Severity = Literal["note", "warning", "error"]

_POWER = {"battery": 2, "motor_current": 2, "motor_currents": 4}
_WIDTHS = {"command": 2, "twist": 2, "wheels": 2, "wheel_speeds": 4, "wheel_commands": 2, "pose": 3, **_POWER}
"""Number of columns of each signal; signals without an entry are one-dimensional."""
_MASKS = {
    "twist": "fresh_twist",
    "wheels": "fresh_twist",
    "wheel_speeds": "fresh_twist",
    "yaw_rate": "fresh_yaw_rate",
    "pose": "fresh_pose",
}
"""Mask of each measured signal; signals of one sensor share a mask."""


@dataclass(frozen=True)
class Record:
    """One contiguous, evenly sampled stretch of a log with K samples. Sample k is at time `start + k dt`.

    Measured signals are interpolated between readings, and NaN far from readings. The `fresh` masks are
    True for samples at a reading and False for interpolated samples. A missing mask is True for every finite sample.

    Attributes
    ----------
    name
        Name of the log and the stretch, for messages: "husky.csv, 12.0 to 660.3 s".
    start
        Time of the first sample on the log's clock [s].
    dt
        Sample time [s].
    command
        (K, 2) commanded v [m/s], omega [rad/s]; row k is held from sample k to sample k + 1.
    twist
        (K, 2) v [m/s], omega [rad/s] from the encoders; None if not logged.
    yaw_rate
        (K,) yaw rate of the gyro [rad/s]; None if not logged.
    pose
        (K, 3) x [m], y [m], theta [rad, unwrapped] in one fixed frame; None if not logged.
    wheels
        (K, 2) measured wheel speeds left, right [rad/s], averaged per side for four wheels; None if not logged.
    wheel_speeds
        (K, 4) wheel speeds front left, front right, rear left, rear right [rad/s]; None unless all four are logged.
    wheel_commands
        (K, 2) commanded wheel speeds left, right [rad/s]; None if the log commands (v, omega).
    battery
        (K, 2) voltage [V], current [A] of the battery; NaN far from readings, None if not logged.
    motor_current
        (K, 2) total motor current left, right [A]; NaN far from readings, None if not logged.
    motor_currents
        (K, 4) motor currents front left, front right, rear left, rear right [A]; None unless all four are logged.
    fresh_twist, fresh_yaw_rate, fresh_pose
        (K,) True for samples with a new reading of the encoders (twist and wheels), the gyro or the pose.
    twist_span
        Number of samples over which each reading of `twist` is a mean, half before and half after its sample; 0 for
        readings of one instant.

    Raises
    ------
    ValueError
        If a shape is wrong, a command is not finite, or a sample marked as fresh is not finite.
    """

    name: str
    start: float
    dt: float
    command: FloatArray
    twist: FloatArray | None = None
    yaw_rate: FloatArray | None = None
    pose: FloatArray | None = None
    wheels: FloatArray | None = None
    wheel_speeds: FloatArray | None = None
    wheel_commands: FloatArray | None = None
    battery: FloatArray | None = None
    motor_current: FloatArray | None = None
    motor_currents: FloatArray | None = None
    fresh_twist: BoolArray | None = None
    fresh_yaw_rate: BoolArray | None = None
    fresh_pose: BoolArray | None = None
    twist_span: int = 0

    def __post_init__(self) -> None:
        """Fill in missing masks and check all fields."""
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"record '{self.name}': sample time {self.dt} s; it must be positive and finite")
        count = len(self.command)
        for name in ("command", "wheel_commands", *_POWER, *_MASKS):
            value = getattr(self, name)
            if value is None:
                continue
            shape = (count, _WIDTHS[name]) if name in _WIDTHS else (count,)
            if value.shape != shape:
                raise ValueError(f"record '{self.name}': {name} has shape {value.shape}, expected {shape}")
            if name in _POWER:
                continue
            finite = np.isfinite(value).reshape(count, -1).all(axis=1)
            if name not in _MASKS:
                required = np.ones(count, dtype=bool)
            else:
                if getattr(self, _MASKS[name]) is None:
                    object.__setattr__(self, _MASKS[name], finite)
                required = getattr(self, _MASKS[name])
            if not finite[required].all():
                raise ValueError(
                    f"record '{self.name}': {name} holds a value that is not finite; split the record there"
                )

    @property
    def time(self) -> FloatArray:
        """(K,) times of the samples on the log's clock [s]."""
        return np.asarray(self.start + self.dt * np.arange(len(self.command)))

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + self.dt * (len(self.command) - 1)

    def fresh(self, name: str) -> BoolArray | None:
        """Return the mask (K,) of samples with new readings of a signal; None if it has no mask or is not logged."""
        return getattr(self, _MASKS[name]) if name in _MASKS and getattr(self, name) is not None else None

    def pose_windows(self, steps: int, usable: BoolArray) -> list[int]:
        """Return the first samples of disjoint windows of `steps` steps with fresh poses at both ends.

        All samples of a window except the last are True in `usable` (K,).
        """
        starts, k = [], 0
        while self.fresh_pose is not None and k + steps < len(self.fresh_pose):
            is_window = self.fresh_pose[k] and self.fresh_pose[k + steps] and usable[k : k + steps].all()
            if is_window:
                starts.append(k)
            k += steps if is_window else 1
        return starts

    def part(self, first: int, stop: int) -> Record:
        """Return the samples from `first` (inclusive) to `stop` (exclusive) as a record."""
        count = len(self.command)
        if not 0 <= first < stop <= count:
            raise ValueError(f"record '{self.name}': samples {first} to {stop} are outside its {count} samples")
        start = self.start + first * self.dt
        end = self.start + (stop - 1) * self.dt
        arrays: dict[str, Any] = {
            entry.name: value[first:stop]
            for entry in fields(self)
            if isinstance(value := getattr(self, entry.name), np.ndarray)
        }
        return replace(self, name=f"{self.name} (part {start:.1f} to {end:.1f} s)", start=start, **arrays)


Topics = Mapping[str, tuple[str, str]]
"""Topic and message type of each stream: "command", "odometry", "imu", "pose"."""

_SIDES = (("left", "right"), ("front_left", "front_right"), ("rear_left", "rear_right"))
EXCHANGES = {"sides": _SIDES, "axes": (("x", "y"),), "channels": (("v", "omega"),)}
"""Pairs of columns that a change exchanges, by its key."""


@dataclass(frozen=True)
class MappingChange:
    """A change of the mapping that may correct a finding; it is tested before it is recommended.

    Attributes
    ----------
    stream
        "command", "encoders", "gyro", "pose"; "time" for the clock of the log; "log" for the whole log.
    key
        Dotted key in the mapping of the stream: "delay", "held", "on_change", "yaw_rate.sign", "left.unit",
        "heading_offset"; "sides", "axes" and "channels" for an exchange of columns; "times" for the stream "log".
    value
        New value. For "delay" the increment [s]; for "sign" -1, which inverts the sign; for
        "times" start and end [s], as "0.0 to 61.5".
    stated
        New value of a "delay" or "sign" in the mapping of the log; None if the mapping is unknown.
    """

    stream: str
    key: str
    value: float | str | bool
    stated: float | None = None

    def __str__(self) -> str:
        """Format the change: "gyro `delay: 0.3`", "pose: exchange x and y"."""
        if self.key in EXCHANGES:
            return f"{self.stream}: exchange {' and '.join(EXCHANGES[self.key][0])}"
        value = self.value if self.stated is None else self.stated
        return f"{self.stream} `{self.key}: {str(value).lower() if isinstance(value, bool) else value}`"


@dataclass(frozen=True)
class Finding:
    """A result of a check of a log, for the user.

    Attributes
    ----------
    kind
        Kind of the finding: "gap", "wrong sign"; a key of `models.doubt.VERDICTS` unless the severity is "note".
    severity
        "note": information only; "warning": the model may be less accurate; "error": the model would be wrong.
    place
        Place in the log as text: times, and rows or messages.
    message
        One sentence with the finding, and with the remedy unless `changes` contains it.
    span
        Start and end [s] on the log's clock; None if the finding has no time.
    changes
        Changes of the mapping that together may correct the fault; empty if the mapping cannot correct it.
    """

    kind: str
    severity: Severity
    place: str
    message: str
    span: tuple[float, float] | None = None
    changes: tuple[MappingChange, ...] = ()

    @property
    def verdict(self) -> DoubtRelevance | None:
        """Relevance of the finding for driving; None for a note."""
        return None if self.severity == "note" else VERDICTS[self.kind]

    def __str__(self) -> str:
        """Format the finding as one line."""
        remedy = f"; in the mapping: {', '.join(map(str, self.changes))}" if self.changes else ""
        return escape(f"{self.place}: {self.message}{remedy}")


@dataclass(frozen=True)
class Log:
    """A log that has been read and checked.

    Attributes
    ----------
    name
        Name of the file or bag.
    records
        Usable stretches in chronological order, all with the same sample time.
    findings
        Errors, warnings and notes in order of detection.
    streams
        Signals of all records, for the diagnosis.
    sources
        Columns or topics of each stream: "command", "encoders", "gyro", "pose".
    topics
        Topics of a bag with their message types.
    """

    name: str
    records: tuple[Record, ...]
    findings: tuple[Finding, ...]
    streams: Streams
    sources: Mapping[str, str] = field(default_factory=dict)
    topics: Topics = field(default_factory=dict)

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings of severity "error"."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    def require_sound(self) -> None:
        """Raise UnsoundLogError with the first error, if there is any."""
        raise_on_error(self.findings)


class UnsoundLogError(ConfigError):
    """Raised if a model that is identified from the log would be wrong.

    Attributes
    ----------
    findings
        All findings of the log; at least one is an error.
    """

    def __init__(self, findings: Sequence[Finding]) -> None:
        errors = [finding for finding in findings if finding.severity == "error"]
        suffix = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        super().__init__(f"{errors[0]}{suffix}")
        self.findings = tuple(findings)


def raise_on_error(findings: Sequence[Finding]) -> None:
    """Raise UnsoundLogError with the first error among findings, if there is any."""
    if any(finding.severity == "error" for finding in findings):
        raise UnsoundLogError(findings)


def format_findings(findings: Sequence[Finding], max_per_kind: int = 2) -> list[str]:
    """Format the first `max_per_kind` findings of each kind as lines with their relevance.

    The last line of a kind ends with the number of omitted findings.
    """
    lines, totals = [], Counter(finding.kind for finding in findings)
    counts: Counter[str] = Counter()
    for finding in findings:
        counts[finding.kind] += 1
        if counts[finding.kind] <= max_per_kind:
            omitted = totals[finding.kind] - max_per_kind if counts[finding.kind] == max_per_kind else 0
            suffix = f" (and {omitted} more like it)" if omitted > 0 else ""
            lines.append(f"{finding}{suffix}" + (f" ({finding.verdict})" if finding.verdict else ""))
    return lines


def format_labelled_findings(findings: Sequence[Finding]) -> list[str]:
    """Format findings as lines that start with the severity; errors come last."""
    groups = {name: [finding for finding in findings if finding.severity == name] for name in get_args(Severity)}
    return [f"{severity}: {line}" for severity, group in groups.items() for line in format_findings(group)]


def format_ranges(numbers: Iterable[int], max_runs: int = 5) -> str:
    """Format ascending numbers as ranges: "3, 7 to 9 and 4 more places" if there are more than `max_runs` ranges."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [f"{first}" if first == last else f"{first} to {last}" for first, last in runs[:max_runs]]
    suffix = f" and {len(runs) - max_runs} more places" if len(runs) > max_runs else ""
    return ", ".join(texts) + suffix
