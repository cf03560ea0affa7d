"""Common form of all logs: evenly sampled stretches in SI units, and findings from reading."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.doubt import VERDICTS, DoubtRelevance
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import escaped

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.diagnosis.streams import Streams

BoolArray = NDArray[np.bool_]
Severity = Literal["note", "warning", "error"]

_WIDTHS = {"command": 2, "twist": 2, "wheels": 2, "wheel_speeds": 4, "wheel_commands": 2, "pose": 3}
_MASKS = {
    "twist": "fresh_twist",
    "wheels": "fresh_twist",
    "wheel_speeds": "fresh_twist",
    "yaw_rate": "fresh_yaw_rate",
    "pose": "fresh_pose",
}


@dataclass(frozen=True)
class Record:
    """One contiguous, evenly sampled stretch of a log, K samples. Sample k belongs to the time `start + k dt`.

    Between two readings a measured signal is interpolated, and NaN where the log has nothing near; only samples that
    the `fresh` masks mark are separate readings. A mask left out marks every finite sample.

    Attributes
    ----------
    name
        Name of the log and the stretch, for messages: "husky.csv, 12.0 to 660.3 s".
    start
        Time of the first sample on the log's clock [s].
    dt
        Sample time [s].
    command
        (K, 2) v [m/s], omega [rad/s] as commanded: the command in force from sample k on.
    twist
        (K, 2) v [m/s], omega [rad/s] from the encoders; None without encoders.
    yaw_rate
        (K,) of the gyro [rad/s]; None without a gyro.
    pose
        (K, 3) x [m], y [m], theta [rad, unwrapped], in one frame throughout; None without poses.
    wheels
        (K, 2) measured wheel speeds left, right [rad/s], of four wheels the mean of each side; None if not logged.
    wheel_speeds
        (K, 4) front left, front right, rear left, rear right [rad/s]; None where the log has not all four.
    wheel_commands
        (K, 2) commanded wheel speeds left, right [rad/s]; None where the log commands (v, omega).
    battery
        (K, 2) voltage [V], current [A] of the battery, NaN without a reading near; None where it is not logged.
    motor_current
        (K, 2) current of the motors left, right [A], of a side together, NaN without one near; None if not logged.
    motor_currents
        (K, 4) front left, front right, rear left, rear right [A]; None where the log has not all four.
    fresh_twist, fresh_yaw_rate, fresh_pose
        (K,) True where a reading of the encoders (twist and wheels), the gyro, the pose falls on the sample.

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

    def __post_init__(self) -> None:
        """Fill in the masks and check."""
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"record '{self.name}': sample time {self.dt} s; it must be positive and finite")
        count = len(self.command)
        for name, width in (("battery", 2), ("motor_current", 2), ("motor_currents", 4)):
            value = getattr(self, name)
            if value is not None and value.shape != (count, width):
                raise ValueError(f"record '{self.name}': {name} has shape {value.shape}, expected {(count, width)}")
        for name in ("command", "wheel_commands", *_MASKS):
            value = getattr(self, name)
            if value is None:
                continue
            shape = (count, _WIDTHS[name]) if name in _WIDTHS else (count,)
            if value.shape != shape:
                raise ValueError(f"record '{self.name}': {name} has shape {value.shape}, expected {shape}")
            finite = np.isfinite(value).reshape(count, -1).all(axis=1)
            if name not in _MASKS:
                checked = np.ones(count, dtype=bool)
            else:
                if getattr(self, _MASKS[name]) is None:
                    object.__setattr__(self, _MASKS[name], finite)
                checked = getattr(self, _MASKS[name])
            if not finite[checked].all():
                raise ValueError(f"record '{self.name}': {name} holds a value that is not finite; cut the record there")

    @property
    def time(self) -> FloatArray:
        """(K,) times of the samples on the log's clock [s]."""
        return np.asarray(self.start + self.dt * np.arange(len(self.command)))

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + self.dt * (len(self.command) - 1)

    def fresh(self, name: str) -> BoolArray | None:
        """Mark samples (K,) of a signal with new readings; None without the signal, or without such a mask."""
        return getattr(self, _MASKS[name]) if name in _MASKS and getattr(self, name) is not None else None

    def pose_windows(self, steps: int, known: BoolArray) -> list[int]:
        """Find first samples of windows of `steps` steps with fresh poses at both ends, `known` (K,) and no overlap."""
        starts, k = [], 0
        while self.fresh_pose is not None and k + steps < len(self.fresh_pose):
            usable = self.fresh_pose[k] and self.fresh_pose[k + steps] and known[k : k + steps].all()
            if usable:
                starts.append(k)
            k += steps if usable else 1
        return starts

    def part(self, first: int, stop: int) -> Record:
        """Return the samples from `first` up to, and without, `stop`, as a record."""
        count = len(self.command)
        if not 0 <= first < stop <= count:
            raise ValueError(f"record '{self.name}': no samples {first} to {stop} among its {count}")
        start = self.start + first * self.dt
        end = self.start + (stop - 1) * self.dt
        cut: dict[str, Any] = {
            entry.name: value[first:stop]
            for entry in fields(self)
            if isinstance(value := getattr(self, entry.name), np.ndarray)
        }
        return replace(self, name=f"{self.name} (of it {start:.1f} to {end:.1f} s)", start=start, **cut)


Topics = Mapping[str, tuple[str, str]]
"""Topic and type of message by stream: "command", "odometry", "imu", "pose"."""


@dataclass(frozen=True)
class MappingChange:
    """A change of the mapping that may repair a finding; whether it does is tried before it is advised.

    Attributes
    ----------
    stream
        "command", "encoders", "gyro", "pose"; "time" for the clock of the log, "log" for changes of no stream.
    key
        Key in the mapping of that stream, with dots: "delay", "held", "on_change", "yaw_rate.sign", "left.unit";
        "heading_offset"; "sides" or "axes", which are exchanged; of the log "times". "v" and "omega" also where wheels
        are mapped.
    value
        Value after the change; for "delay" and "heading_offset" the increment [s, rad], for "sign" -1, which inverts
        it; for "times" from and to [s], as "0.0 to 61.5".
    """

    stream: str
    key: str
    value: float | str | bool

    def __str__(self) -> str:
        """Format the change: "gyro `delay: +0.30`"."""
        value = str(self.value).lower() if isinstance(self.value, bool) else str(self.value)
        return f"{self.stream} `{self.key}: {f'{self.value:+.2f}' if self.key == 'delay' else value}`"


@dataclass(frozen=True)
class Finding:
    """Something in a log that its user should know.

    Attributes
    ----------
    kind
        Kind of the finding, in a word or two, the same for all of its kind: "gap", "wrong sign"; a key of
        `models.doubt.VERDICTS` where it is more than a note.
    severity
        "note": it is so; "warning": the model may suffer; "error": a model from this log would be wrong.
    place
        Place in the log, in words: times, and rows or messages.
    words
        One sentence with the finding and with the remedy, unless `changes` are the remedy.
    span
        From and to [s] on the log's clock, where the finding has a place in time.
    changes
        Changes of the mapping, all together, that may repair it; empty where no mapping can.
    """

    kind: str
    severity: Severity
    place: str
    words: str
    span: tuple[float, float] | None = None
    changes: tuple[MappingChange, ...] = ()

    @property
    def verdict(self) -> DoubtRelevance | None:
        """Relevance for driving; None for a note."""
        return None if self.severity == "note" else VERDICTS[self.kind]

    def __str__(self) -> str:
        """Format one line."""
        remedy = f"; in the mapping: {', '.join(map(str, self.changes))}" if self.changes else ""
        return escaped(f"{self.place}: {self.words}{remedy}")


@dataclass(frozen=True)
class Log:
    """A log that has been read and checked.

    Attributes
    ----------
    name
        Name of the file or bag.
    records
        The stretches that can be used, all with the same sample time, in the order of the log.
    findings
        Errors, warnings and notes in the order found.
    streams
        Signals of the records, side by side, for the diagnosis.
    sources
        Columns or topics by stream: "command", "encoders", "gyro", "pose".
    topics
        Topics of a bag, with the types of their messages.
    """

    name: str
    records: tuple[Record, ...]
    findings: tuple[Finding, ...]
    streams: Streams
    sources: Mapping[str, str] = field(default_factory=dict)
    topics: Topics = field(default_factory=dict)

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings that would make a model wrong."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    def require_sound(self) -> None:
        """Raise ConfigError with the line of the first finding that is an error; do nothing where there is none."""
        refuse(self.findings)


class UnsoundLogError(ConfigError):
    """A log would give a wrong model.

    Attributes
    ----------
    findings
        All that are known of it; at least one is an error.
    """

    def __init__(self, findings: Sequence[Finding]) -> None:
        errors = [finding for finding in findings if finding.severity == "error"]
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        super().__init__(f"{errors[0]}{more}")
        self.findings = tuple(findings)


def refuse(findings: Sequence[Finding]) -> None:
    """Raise UnsoundLogError with the line of the first error among findings; do nothing where there is none."""
    if any(finding.severity == "error" for finding in findings):
        raise UnsoundLogError(findings)


def counted(findings: Sequence[Finding], most: int = 2) -> list[str]:
    """Format one line per finding, relevance included; for each kind the first `most`, and the number of the rest."""
    lines, by_kind = [], Counter(finding.kind for finding in findings)
    shown: Counter[str] = Counter()
    for finding in findings:
        shown[finding.kind] += 1
        if shown[finding.kind] <= most:
            left = by_kind[finding.kind] - most if shown[finding.kind] == most else 0
            more = f" (and {left} more like it)" if left > 0 else ""
            lines.append(f"{finding}{more}" + (f" ({finding.verdict})" if finding.verdict else ""))
    return lines


def ranges(numbers: Iterable[int], most: int = 5) -> str:
    """Format numbers in ascending order as words: "3, 7 to 9 and 4 more places"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    shown = [f"{a}" if a == b else f"{a} to {b}" for a, b in runs[:most]]
    more = f" and {len(runs) - most} more places" if len(runs) > most else ""
    return ", ".join(shown) + more
