"""What is done to a sound log, and what must be said about it then."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from degraded_bases import RADIUS, TRACK, robot

UNIT = ("wrong unit",)
SIGN = ("wrong sign",)
SHIFT = ("time shift",)


@dataclass(frozen=True)
class Case:
    """One degraded log.

    Attributes
    ----------
    base
        Of `BASES`.
    what
        Was done, in words.
    change
        (columns, base) -> columns of the degraded log; of several logs, a list.
    kind
        Kinds of finding that name the cause; empty where nothing is wrong.
    says
        What the sentence must hold: the stream and the remedy.
    refused
        Whether no configuration may come of it; None where it may or may not.
    mapping
        (text) -> text of the mapping.
    also
        Kinds that may stand beside: consequences that are true.
    """

    base: str
    what: str
    change: Callable
    kind: tuple[str, ...] = ()
    says: tuple[str, ...] = ()
    refused: bool | None = False
    mapping: Callable[[str], str] = str
    also: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Base and change."""
        return f"{self.base}: {self.what}"


def shifted(stream, seconds):
    """The readings of one stream appear `seconds` later in the log, inside each segment."""

    def change(columns, base):
        rows = round(seconds / base.dt)
        segment = columns.get("calib_step" if "sample_time" in base.mapping else "segment", np.zeros(len(columns["x"])))
        result = dict(columns)
        for part in np.split(np.arange(len(segment)), np.flatnonzero(np.diff(segment)) + 1):
            source = np.clip(part - rows, part[0], part[-1])
            for name in base.stream(stream):
                result[name] = np.array(result[name])
                result[name][part] = columns[name][source]
        return result

    return change


def scaled(**factors):
    """Columns times a number; keys are streams or names of columns."""

    def change(columns, base):
        result = dict(columns)
        for key, factor in factors.items():
            for name in base.stream(key) if key in ("command", "encoders", "gyro", "pose") else (key,):
                result[name] = columns[name] * factor
        return result

    return change


def swapped(first, second):
    def change(columns, base):
        names = [base.wheels[0], base.wheels[1]] if first == "left" else [first, second]
        return columns | {names[0]: columns[names[1]], names[1]: columns[names[0]]}

    return change


def one_wheel(side, factor):
    """The encoder of one side (0 left, 1 right) times a number."""

    def change(columns, base):
        return columns | {base.wheels[side]: columns[base.wheels[side]] * factor}

    return change


def from_the_middle(stream, factor):
    def change(columns, base):
        later = np.arange(len(columns["x"])) >= len(columns["x"]) // 2
        return columns | {name: np.where(later, factor, 1.0) * columns[name] for name in base.stream(stream)}

    return change


def spikes(names, size, share=0.01, seed=3):
    """Readings here and there are replaced by ones far off."""

    def change(columns, base):
        rng = np.random.default_rng(seed)
        result = dict(columns)
        for name in names:
            hit = rng.random(len(columns[name])) < share
            result[name] = np.where(hit, size * rng.choice([-1.0, 1.0], len(hit)), columns[name])
        return result

    return change


def replaced(**columns):
    """Columns as given by functions of the columns."""
    return lambda before, base: before | {name: make(before) for name, make in columns.items()}


def rows(chosen):
    """Some rows only, or in another order."""

    def change(columns, base):
        keep = chosen(columns)
        return {name: value[keep] for name, value in columns.items()}

    return change


def simulated(**options):
    """Another simulated robot, or another drive of it."""
    return lambda columns, base: robot(**options)


def shuffled_rows(columns):
    order = np.arange(len(columns["t"]))
    return np.argsort(order + np.random.default_rng(5).uniform(0, 4, len(order)), kind="stable")


def shuffled_stamps(columns):
    return columns["t"][shuffled_rows(columns)]


def in_bursts(columns, size=10):
    time = columns["t"]
    return time[np.minimum(np.arange(len(time)) // size * size + size - 1, len(time) - 1)] + 1e-4 * (
        np.arange(len(time)) % size
    )


def running_counts(name):
    """Running ticks of a wheel speed [rad/s], 4096 a turn."""
    return lambda columns: np.floor(np.cumsum(columns[name] * 0.02) * 4096 / (2 * np.pi))


def held(name, period):
    return lambda columns: columns[name][np.arange(len(columns[name])) // period * period]


def rounded(name, quantum):
    return lambda columns: np.round(columns[name] / quantum) * quantum


def frozen(name, share):
    return lambda columns: np.where(
        np.arange(len(columns[name])) < (1 - share) * len(columns[name]),
        columns[name],
        columns[name][int((1 - share) * len(columns[name]))],
    )


def without_some_seconds(columns):
    inside = columns["t"] % 30.0
    return (inside < 20.0) | (inside > 23.0)


def some_nan(name):
    return lambda columns: np.where(np.random.default_rng(6).random(len(columns[name])) < 0.02, np.nan, columns[name])


def four_wheels(dead=None):
    def change(columns, base):
        wheels = {"fl": "left", "fr": "right", "rl": "left", "rr": "right"}
        rng = np.random.default_rng(8)
        noise = {name: rng.normal(0, 0.03, len(columns["t"])) for name in wheels}
        return columns | {
            name: 0.0 * noise[name] if name == dead else columns[of] + noise[name] for name, of in wheels.items()
        }

    return change


def twist_columns(columns, base):
    left, right = columns["left"], columns["right"]
    return columns | {"v": 0.5 * RADIUS * (left + right), "omega_wheels": RADIUS * (right - left) / TRACK}


def put(old, new):
    return lambda text: text.replace(old, new)
