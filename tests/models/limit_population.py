"""Drawn logs in which a command is clipped at a known level, or nothing is; what the linear fits find of it.

`python tests/models/limit_population.py --seed 11 --count 60` prints how many limits are found, how many of them within
5 %, and how many are found where there is none; it ends with 1 where these are too few or too many. Real logs lie where
DIFFDRIVE_MPC_DATA says; without it only drawn robots take part.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from real_log_files import FOLDERS, log_path
from scipy import signal

from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.validation import simulate_records
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.velocity_model import CHANNELS

OWN = {"warthog_asphalt": (3.7, 4.4), "warthog_gravel": (3.7, 4.4)}
"""Limits of v that the robots themselves have [m/s]: found there, one is not false."""
TOLERANCE = 0.05
FEWEST, MOST_FALSE = 0.8, 0.05
"""Share of the drawn limits that has to be found within the tolerance, and most false finds in a log."""
_ROWS = 4000
_SHARES = (0.6, 0.9)
_ODD = ("nothing", "slew", "compressed gain", "dead band", "sagging gain", "gain of the other channel")


@dataclass(frozen=True)
class LimitCase:
    """A log, and what limits its commands.

    Attributes
    ----------
    name
        For tables.
    records
        The log.
    channel
        Whose command is clipped; None where none is.
    level
        At which it is [m/s, rad/s].
    known
        Range of a limit of v that is no false find [m/s].
    """

    name: str
    records: tuple[Record, ...]
    channel: str | None
    level: float
    known: tuple[float, float] = (np.inf, -np.inf)


def drawn_case(seed: int) -> LimitCase:
    """A simulated robot with two lags and a dead time, whose commands one limit clips, or no limit.

    Its speeds deviate from that by correlated noise; without a limit something else is odd of it.
    """
    rng = np.random.default_rng(seed)
    dt, count = 0.05, int(rng.integers(1500, 5000))
    command = np.column_stack([_drive(rng, dt, count) for _ in CHANNELS]) * rng.uniform([0.4, 0.6], [4.0, 3.0])
    row = int(rng.integers(2))
    limited = rng.random() < 0.5
    odd = "nothing" if limited else str(rng.choice(_ODD))
    taken = command.copy()
    level = np.inf
    if limited:
        level = rng.uniform(*_SHARES) * np.quantile(np.abs(command[:, row]), 0.995)
        taken[:, row] = np.clip(taken[:, row], -level, level)
    size = np.abs(command).max(axis=0)
    if odd == "compressed gain":
        taken = size * np.tanh(0.5 * taken / size) / 0.5
    elif odd == "dead band":
        taken = np.sign(taken) * np.maximum(np.abs(taken) - 0.08 * size, 0.0)
    elif odd == "sagging gain":
        taken *= np.linspace(1.0, 0.85, count)[:, None]
    elif odd == "gain of the other channel":
        taken *= 1.0 - 0.2 * np.abs(command[:, ::-1]) / size[::-1]
    elif odd == "slew":
        taken = _slewed(taken, rng.uniform(0.5, 2.0) * size * dt)
    speeds = np.column_stack([_answer(rng, column, dt) for column in taken.T])
    keep = np.exp(-dt / rng.uniform(0.1, 1.0))
    white = rng.normal(size=(count, 2)) * np.sqrt(1 - keep**2)
    speeds += rng.uniform(0.01, 0.15) * speeds.std(axis=0) * signal.lfilter([1.0], [1.0, -keep], white, axis=0)
    speeds += 0.01 * speeds.std(axis=0) * rng.normal(size=(count, 2))
    record = Record(f"robot {seed}", 0.0, dt, command, twist=speeds, yaw_rate=speeds[:, 1].copy())
    return LimitCase(f"robot {seed}, {odd}", (record,), CHANNELS[row] if limited else None, level)


def _drive(rng, dt, count):
    """(K,) commands between -1 and 1 of one of three kinds: steps, steps with ramps, sums of sines."""
    kind, time = rng.integers(3), dt * np.arange(count)
    if kind == 2:
        rates, phases = rng.uniform(0.1, 1.5, 4), rng.uniform(0, 2 * np.pi, 4)
        return np.sin(np.outer(time, rates) + phases).mean(axis=1)
    hold = round(rng.uniform(0.7, 4.0) / dt)
    levels = rng.uniform(-1, 1, count // hold + 2) * rng.random(count // hold + 2) ** rng.uniform(0.0, 1.0)
    steps = np.repeat(levels, hold)[:count]
    width = 1 if kind == 0 else max(1, hold // 2)
    return signal.lfilter(np.full(width, 1 / width), [1.0], steps)


def _answer(rng, taken, dt):
    """(K,) the speed of a drawn channel."""
    late, keep = int(rng.integers(0, 5)), np.exp(-dt / rng.uniform(0.03, 0.4))
    delayed = np.concatenate([np.zeros(late + 1), taken])[: len(taken)]
    for part in (keep, keep ** rng.uniform(1.0, 5.0)):
        delayed = signal.lfilter([1 - part], [1.0, -part], delayed)
    return rng.uniform(0.6, 1.1) * delayed


def _slewed(values, most):
    result = values.copy()
    for k in range(1, len(result)):
        result[k] = result[k - 1] + np.clip(values[k] - result[k - 1], -most, most)
    return result


@cache
def _real(name):
    return read_log(log_path(name), name).records


def real_case(name: str, seed: int) -> LimitCase:
    """A stretch of a real log: what a limit of a command would change by a model of it is added to the readings."""
    rng = np.random.default_rng(seed)
    records = _stretch(_real(name), rng)
    own = OWN.get(name, LimitCase.known)
    limited = rng.random() < 0.6
    if not limited:
        return LimitCase(f"{name} {seed}", records, None, np.inf, own)
    row = 1 if name in OWN else int(rng.integers(2))
    model = identify_sm(records, limits=False).system
    plain = simulate_records(model, records)
    gain = abs(float((model.C @ np.linalg.solve(-model.A, model.B))[row, row]))
    level = rng.uniform(*_SHARES) * np.quantile(np.abs(np.concatenate(plain)[:, row]), 0.995) / gain
    limit = np.full(2, np.inf)
    limit[row] = level
    clipped = simulate_records(model._replace(limit=limit), records)
    changed = []
    for record, before, after in zip(records, plain, clipped, strict=True):
        change = after - before
        twist, yaw_rate = record.twist.copy(), record.yaw_rate + change[:, 1]
        twist[:, 0] += change[:, 0]
        changed.append(replace(record, twist=twist, yaw_rate=yaw_rate))
    return LimitCase(f"{name} {seed}", tuple(changed), CHANNELS[row], level, own)


def _stretch(records, rng):
    """About `_ROWS` rows in one go."""
    left, parts = int(rng.integers(sum(len(record.command) for record in records) - _ROWS)), []
    right = left + _ROWS
    for record in records:
        count = len(record.command)
        first, last = max(left, 0), min(right, count)
        if last - first > 40:
            parts.append(record.part(first, last))
        left, right = left - count, right - count
    return tuple(parts)


def population(seed: int, count: int) -> list[LimitCase]:
    """`count` drawn robots, and a third as many stretches of real logs where these are at hand."""
    cases = [drawn_case(1000 * seed + i) for i in range(count)]
    if "DIFFDRIVE_MPC_DATA" in os.environ:
        cases += [real_case(list(FOLDERS)[i % len(FOLDERS)], 1000 * seed + i) for i in range(count // 3)]
    return cases


def judged(case: LimitCase, limits) -> tuple[bool, bool, int]:
    """Whether the limit was found, whether within the tolerance, and how many were found where there are none."""
    is_found = case.channel in limits
    close = is_found and abs(limits[case.channel] / case.level - 1) <= TOLERANCE
    low, high = case.known
    false = [name for name in limits if name != case.channel and not (name == "v" and low < limits[name] < high)]
    return is_found, close, len(false)


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=60)
    words = parser.parse_args()
    totals = {"drawn robots": np.zeros(5, dtype=int), "real logs": np.zeros(5, dtype=int)}
    for case in population(words.seed, words.count):
        limits = identify_sm(case.records).limits
        found, close, false = judged(case, limits)
        group = "drawn robots" if case.name.startswith("robot") else "real logs"
        totals[group] += [1, case.channel is not None, found, close, false]
        if (case.channel is not None and not close) or false:
            sys.stdout.write(f"{case.name}: {case.channel} {case.level:.3g}, found {dict(limits)}\n")
            sys.stdout.flush()
    for group, (cases, there, found, close, false) in totals.items():
        sys.stdout.write(
            f"{group}: {found} of {there} limits found, {close} within {TOLERANCE:.0%}; {false} false in {cases} logs\n"
        )
    cases, there, _, close, _ = totals["drawn robots"]
    false = sum(total[4] for total in totals.values())
    sys.exit(bool(close < FEWEST * there or false > MOST_FALSE * cases))


if __name__ == "__main__":
    main()
