"""Broken controllers that nobody chose: kinds drawn from a seed, each a fault of command or measurement or two of them.

Kinds with even numbers are for building rules. The others are reserved: rules are only reported on them. The reserved
kinds of seed 36 were looked at once; those of today are of seed 137, from faults that were no kind by themselves. Kinds
from `KINDS` on are those of `NAMED`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from studies.monitor.faults import SAMPLE, Fault, Sent

from diffdrive_mpc.models.interface import Measurement, Stamped

KINDS, _SINGLE = 40, 26
"""So many kinds, of which the first are one fault each, and the others two."""
_SEED, _RESERVED_SEED = 36, 137
Twist = tuple[float, float]
Change = Callable[[float, float, float, float], Twist]
"""What is sent for: seconds since the fault began, seconds since the reference ended, v [m/s], omega [rad/s]."""
Sense = Callable[[float, Measurement], Measurement]
"""What the controller makes of a measurement so long after the fault began [s]."""
Random = np.random.Generator


def _signed(draw: Random, low: float, high: float) -> float:
    """Between two values by its logarithm, of either sign."""
    return float(math.exp(draw.uniform(math.log(low), math.log(high))) * draw.choice([-1.0, 1.0]))


def _beside_one(draw: Random) -> float:
    """A gain that is clearly wrong."""
    return float(draw.uniform(0.0, 0.7) if draw.random() < 0.5 else draw.uniform(1.4, 3.0))


def _every(draw: Random, shortest: float, longest: float) -> Callable[[float], bool]:
    """Whether a periodic fault is present at a time."""
    period, share = draw.uniform(shortest, longest), draw.uniform(0.3, 0.8)
    return lambda t: t % period < share * period


def _delay(draw: Random) -> Change:
    kept: deque[Twist] = deque(maxlen=round(draw.uniform(0.2, 1.5) / SAMPLE))

    def change(_t: float, _e: float, v: float, w: float) -> Twist:
        kept.append((v, w))
        return kept[0]

    return change


def _low_pass(draw: Random) -> Change:
    share, last = SAMPLE / draw.uniform(0.5, 2.0), np.zeros(2)

    def change(_t: float, _e: float, v: float, w: float) -> Twist:
        last[:] += share * (np.array([v, w]) - last)
        return float(last[0]), float(last[1])

    return change


def _held(draw: Random) -> Change:
    present, last = _every(draw, 1.0, 4.0), [(0.0, 0.0)]

    def change(t: float, _e: float, v: float, w: float) -> Twist:
        last[0] = last[0] if present(t) else (v, w)
        return last[0]

    return change


def _gain(draw: Random, v_too: bool, omega_too: bool) -> Change:
    gain = _beside_one(draw)
    return lambda _t, _e, v, w: (gain * v if v_too else v, gain * w if omega_too else w)


def _added(draw: Random, low: Twist, high: Twist, shape: Callable[[float], float]) -> Change:
    """Something is added to v or omega: a constant, a ramp or a wave."""
    a, b = (_signed(draw, *ends) if ends[1] else 0.0 for ends in (low, high))
    return lambda t, _e, v, w: (v + a * shape(t), w + b * shape(t))


def _wave(draw: Random) -> Callable[[float], float]:
    period = draw.uniform(0.5, 4.0)
    return (lambda t: t / period % 1.0) if draw.random() < 0.5 else (lambda t: math.sin(2 * math.pi * t / period))


def _limited(draw: Random, v_most: Twist, omega_most: Twist) -> Change:
    a, b = draw.uniform(*v_most), draw.uniform(*omega_most)
    return lambda _t, _e, v, w: (min(max(v, -a), a), min(max(w, -b), b))


def _stopped(draw: Random, longest: float) -> Change:
    until = draw.uniform(1.0, longest)
    return lambda t, _e, v, w: (0.0, 0.0) if t < until else (v, w)


def _stutter(draw: Random) -> Change:
    present = _every(draw, 0.3, 2.0)
    return lambda t, _e, v, w: (0.0, 0.0) if present(t) else (v, w)


def _after_end(draw: Random, v_most: Twist, omega_most: Twist) -> Change:
    a, b = (_signed(draw, *ends) if ends[1] else 0.0 for ends in (v_most, omega_most))
    return lambda _t, e, v, w: (a, b) if e > -0.3 else (v, w)


def _coarse(draw: Random) -> Change:
    step = draw.uniform(0.2, 0.6)
    return lambda _t, _e, v, w: (step * round(v / step), 2 * step * round(w / step / 2))


def _one_sided(draw: Random) -> Change:
    side = draw.choice([-1.0, 1.0])
    return lambda _t, _e, v, w: (v, w if side * w > 0.0 else 0.0)


_NONE = (0.0, 0.0)
_FIRST_COMMANDS: dict[str, Callable[[Random], Change]] = {
    "commands delayed": _delay,
    "commands smoothed": _low_pass,
    "commands held": _held,
    "v scaled": lambda draw: _gain(draw, v_too=True, omega_too=False),
    "omega scaled": lambda draw: _gain(draw, v_too=False, omega_too=True),
    "v and omega scaled": lambda draw: _gain(draw, v_too=True, omega_too=True),
    "omega inverted": lambda _draw: lambda _t, _e, v, w: (v, -w),
    "v and omega swapped": lambda _draw: lambda _t, _e, v, w: (w, v),
    "offset of v": lambda draw: _added(draw, (0.1, 0.4), _NONE, lambda _t: 1.0),
    "offset of omega": lambda draw: _added(draw, _NONE, (0.2, 1.0), lambda _t: 1.0),
    "drift of v": lambda draw: _added(draw, (0.03, 0.3), _NONE, lambda t: t),
    "drift of omega": lambda draw: _added(draw, _NONE, (0.05, 0.5), lambda t: t),
    "wave on v": lambda draw: _added(draw, (0.1, 0.6), _NONE, _wave(draw)),
    "wave on omega": lambda draw: _added(draw, _NONE, (0.3, 1.5), _wave(draw)),
    "v saturated": lambda draw: _limited(draw, (0.1, 0.35), (9.0, 9.0)),
    "omega saturated": lambda draw: _limited(draw, (9.0, 9.0), (0.05, 0.4)),
    "stops half way": lambda draw: _stopped(draw, 60.0),
    "pauses": lambda draw: _stopped(draw, 4.0),
    "stutters": _stutter,
    "creeps after the end": lambda draw: _after_end(draw, (0.035, 0.3), _NONE),
    "turns after the end": lambda draw: _after_end(draw, _NONE, (0.1, 1.0)),
    "commands coarse": _coarse,
    "one side lost": _one_sided,
}


def _dead_band(draw: Random) -> Change:
    v_least, omega_least = draw.uniform(0.1, 0.4), draw.uniform(0.1, 0.6)
    return lambda _t, _e, v, w: (v if abs(v) > v_least else 0.0, w if abs(w) > omega_least else 0.0)


def _omega_drops_out(draw: Random) -> Change:
    present = _every(draw, 0.5, 4.0)
    return lambda t, _e, v, w: (v, 0.0 if present(t) else w)


def _gain_drifts(draw: Random) -> Change:
    rate = _signed(draw, 0.05, 0.5)
    return lambda t, _e, v, w: (v, max(0.0, 1.0 + rate * t) * w)


def _v_lags(draw: Random) -> Change:
    share, last = SAMPLE / draw.uniform(2.0, 6.0), [math.nan]

    def change(_t: float, _e: float, v: float, w: float) -> Twist:
        last[0] = v if math.isnan(last[0]) else last[0] + share * (v - last[0])
        return last[0], w

    return change


def _omega_sums(draw: Random) -> Change:
    rate, total = draw.uniform(0.3, 2.0), [0.0]

    def change(_t: float, _e: float, v: float, w: float) -> Twist:
        total[0] += rate * SAMPLE * w
        return v, w + total[0]

    return change


COMMANDS = _FIRST_COMMANDS | {
    "dead band of commands": _dead_band,
    "omega drops out": _omega_drops_out,
    "gain of omega drifts": _gain_drifts,
    "v lags": _v_lags,
    "omega sums up": _omega_sums,
}
"""What may happen to commands."""


def _moved(change: Callable[[float, np.ndarray], np.ndarray]) -> Sense:
    """The controller takes poses for others, (3,) x [m], y [m], theta [rad]."""

    def sense(t: float, measurement: Measurement) -> Measurement:
        pose = measurement.pose
        if pose is None:
            return measurement
        return replace(measurement, pose=replace(pose, value=change(t, np.asarray(pose.value, dtype=float))))

    return sense


def _shifted(draw: Random, position: Twist, heading: Twist, shape: Callable[[float], float]) -> Sense:
    course = draw.uniform(-math.pi, math.pi)
    size, turn = (abs(_signed(draw, *position)) if position[1] else 0.0), (_signed(draw, *heading) if heading[1] else 0)
    offset = np.array([size * math.cos(course), size * math.sin(course), turn])
    return _moved(lambda t, pose: pose + shape(t) * offset)


def _late_poses(draw: Random) -> Sense:
    late, kept = draw.uniform(0.3, 1.5), deque[tuple[float, np.ndarray]]()

    def change(t: float, pose: np.ndarray) -> np.ndarray:
        kept.append((t, pose))
        while len(kept) > 1 and kept[1][0] <= t - late:
            kept.popleft()
        return kept[0][1]

    return _moved(change)


def _scaled_sensor(name: str, gain: float, offset: float) -> Sense:
    def sense(_t: float, measurement: Measurement) -> Measurement:
        reading: Stamped | None = getattr(measurement, name)
        if reading is None:
            return measurement
        scaled: dict[str, Any] = {name: replace(reading, value=gain * np.asarray(reading.value) + offset)}
        return replace(measurement, **scaled)

    return sense


def _frozen(_draw: Random) -> Sense:
    first: list[np.ndarray] = []

    def change(_t: float, pose: np.ndarray) -> np.ndarray:
        first.append(pose)
        return first[0]

    return _moved(change)


_FIRST_SENSES: dict[str, Callable[[Random], Sense]] = {
    "heading estimate drifts": lambda draw: _shifted(draw, _NONE, (0.02, 0.25), lambda t: t),
    "position estimate drifts": lambda draw: _shifted(draw, (0.03, 0.3), _NONE, lambda t: t),
    "heading estimate off": lambda draw: _shifted(draw, _NONE, (0.1, 0.8), lambda _t: 1.0),
    "position estimate off": lambda draw: _shifted(draw, (0.12, 0.6), _NONE, lambda _t: 1.0),
    "poses late": _late_poses,
    "poses frozen": _frozen,
    "poses mirrored": lambda _draw: _moved(lambda _t, pose: pose * [1.0, -1.0, -1.0]),
    "poses lost": lambda _draw: lambda _t, measurement: replace(measurement, pose=None),
    "wheels scaled": lambda draw: _scaled_sensor("wheel_twist", _beside_one(draw), 0.0),
    "gyro scaled": lambda draw: _scaled_sensor("yaw_rate", _beside_one(draw), 0.0),
    "gyro biased": lambda draw: _scaled_sensor("yaw_rate", 1.0, _signed(draw, 0.1, 0.6)),
}


def _noisy_poses(draw: Random) -> Sense:
    sizes, noise = draw.uniform(0.05, 0.3) * np.array([1.0, 1.0, 0.5]), np.random.default_rng(draw.integers(2**31))
    return _moved(lambda _t, pose: pose + sizes * noise.normal(size=3))


def _scaled_poses(draw: Random) -> Sense:
    scale, first = float(draw.choice([draw.uniform(0.6, 0.9), draw.uniform(1.1, 1.5)])), list[np.ndarray]()

    def change(_t: float, pose: np.ndarray) -> np.ndarray:
        first.append(pose)
        return np.array([*(first[0] + scale * (pose - first[0]))[:2], pose[2]])

    return _moved(change)


def _poses_jump(draw: Random) -> Sense:
    present, course, size = _every(draw, 0.5, 4.0), draw.uniform(-math.pi, math.pi), draw.uniform(0.12, 0.5)
    offset = size * np.array([math.cos(course), math.sin(course), 0.0])
    return _moved(lambda t, pose: pose + present(t) * offset)


def _held_poses(draw: Random) -> Sense:
    present, last = _every(draw, 1.0, 5.0), list[np.ndarray]()

    def change(t: float, pose: np.ndarray) -> np.ndarray:
        last[:] = last if last and present(t) else [pose]
        return last[0]

    return _moved(change)


def _stuck(name: str) -> Sense:
    """A sensor repeats its first reading, with fresh stamps."""
    first: list[Stamped] = []

    def sense(_t: float, measurement: Measurement) -> Measurement:
        reading: Stamped | None = getattr(measurement, name)
        if reading is None:
            return measurement
        first.append(reading)
        repeated: dict[str, Any] = {name: replace(reading, value=first[0].value)}
        return replace(measurement, **repeated)

    return sense


SENSES = _FIRST_SENSES | {
    "poses noisy": _noisy_poses,
    "poses scaled": _scaled_poses,
    "poses jump": _poses_jump,
    "poses held": _held_poses,
    "wheels stuck": lambda _draw: _stuck("wheel_twist"),
    "gyro stuck": lambda _draw: _stuck("yaw_rate"),
}
"""What the controller may make of its measurements."""


_NAMED_COMMANDS: dict[str, Callable[[Random], Change]] = {
    "v times 1.6": lambda _draw: lambda _t, _e, v, w: (1.6 * v, w),
    "stops half way for good": lambda _draw: lambda _t, _e, _v, _w: (0.0, 0.0),
    "stutters, half a second each": lambda _draw: lambda t, _e, v, w: (0.0, 0.0) if t % 1.0 < 0.5 else (v, w),
    "turns on after the end": lambda _draw: lambda _t, e, v, w: (0.0, 0.3) if e > -0.3 else (v, w),
    "creeps on after the end": lambda _draw: lambda _t, e, v, w: (0.06, 0.0) if e > -0.3 else (v, w),
    "saw-tooth of 0.3 m/s on v": lambda _draw: lambda t, _e, v, w: (v + 0.3 * (t / 2.0 % 1.0), w),
}
_NAMED_SENSES: dict[str, Callable[[Random], Sense]] = {
    "heading drifts by 6 degrees/s": lambda _draw: _moved(lambda t, pose: pose + [0.0, 0.0, math.radians(6.0) * t]),
}
NAMED = (*_NAMED_COMMANDS, *_NAMED_SENSES)
"""Broken controllers that a report named, one fault each."""
NAMED_KINDS = range(KINDS, KINDS + len(NAMED))
_ALL_COMMANDS, _ALL_SENSES = COMMANDS | _NAMED_COMMANDS, SENSES | _NAMED_SENSES


def parts_of(kind: int) -> tuple[str, ...]:
    """Names of the one or two faults of a kind; of those with one fault no two have the same."""
    if kind >= KINDS:
        return (NAMED[kind - KINDS],)
    first = np.random.default_rng(_SEED).permutation([*_FIRST_COMMANDS, *_FIRST_SENSES]).tolist()
    names, seed = first, _SEED
    if kind % 2:
        names = [name for name in (*COMMANDS, *SENSES) if name not in first[:_SINGLE]]
        names, seed = np.random.default_rng(_RESERVED_SEED).permutation(names).tolist(), _RESERVED_SEED
    if kind < _SINGLE:
        return (str(names[kind // 2 if kind % 2 else kind]),)
    everything = [*COMMANDS, *SENSES] if kind % 2 else first
    pair = np.random.default_rng([seed, kind]).choice(everything, 2, replace=False)
    return tuple(map(str, pair))


class DrawnFault(Fault):
    """The broken controller of a kind; its numbers are drawn from `seed`."""

    def __init__(self, kind: int, seed: int, begins: float) -> None:
        super().__init__(begins)
        draw = np.random.default_rng([_SEED, kind, seed])
        self._changes = [_ALL_COMMANDS[name](draw) for name in parts_of(kind) if name in _ALL_COMMANDS]
        self._senses = [_ALL_SENSES[name](draw) for name in parts_of(kind) if name in _ALL_SENSES]

    def sees(self, measurement: Measurement) -> Measurement:
        """Distort the measurement."""
        for sense in self._senses:
            measurement = sense(self._now - self.begins, measurement)
        return measurement

    def active(self, t: float) -> bool:
        """Whether something is wrong at `t` [s]."""
        self._now = t
        return super().active(t)

    def sends(self, command: Sent) -> list[Sent]:
        """Distort the command, within range and slew."""
        v, omega = command.v, command.omega
        for change in self._changes:
            v, omega = change(command.stamp - self.begins, command.stamp - self._end, v, omega)
        return self.smooth(command.stamp, v, omega) if self._changes else [command]
