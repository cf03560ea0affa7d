"""Check the commands of a live node against the promises of docs/safety.md; needs no ROS.

Each command is a tick. Between ticks it changes by at most slew, or braking, times the sample time. It may become
zero at once if the node reports STOPPED, FAULT or IDLE, or by request (deactivation; a signal, after its ramp).
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

# Between what a process notes and what another notes of the same [s]: scheduling, discovery, delivery.
SLACK = 0.35
# Commands further apart than this while active let a base stop by its own timeout [s].
MOST_GAP = 1.0
_ROUNDING = 1e-6
_AT_ONCE = ("STOPPED", "FAULT", "IDLE", "FINISHED")


@dataclass(frozen=True)
class Heard:
    """A command as it arrived."""

    time: float
    v: float
    omega: float
    number: int | None = None
    others: bool = False


@dataclass(frozen=True)
class Allowed:
    """Limits from `start` on, until the next: v, omega, and how far a tick may change them."""

    start: float
    most: tuple[float, float]
    step: tuple[float, float]


@dataclass
class Account:
    """Events of a campaign, by the monotonic clock [s]."""

    commands: list[Heard] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    allowed: list[Allowed] = field(default_factory=list)
    # When the node may fall to zero at once because somebody asked it to.
    requested: list[float] = field(default_factory=list)
    # From when to when the command has to be zero, and why.
    zero: list[tuple[float, float, str]] = field(default_factory=list)
    # From when to when the node was active, ticks being due.
    active: list[tuple[float, float]] = field(default_factory=list)
    # From when to when the clock of the ticks stood, so that none were due.
    stood: list[tuple[float, float]] = field(default_factory=list)


def faults(account: Account) -> list[str]:
    """Return a line for each broken promise."""
    return [*_of_values(account), *_of_steps(account), *_of_zeros(account), *_of_gaps(account)]


def _of_values(account: Account) -> list[str]:
    lines = []
    for entry in account.commands:
        if not (math.isfinite(entry.v) and math.isfinite(entry.omega)):
            lines.append(f"not finite: {entry}")
        elif entry.others:
            lines.append(f"something beside v and omega is not zero: {entry}")
    return lines


def _of_steps(account: Account) -> list[str]:
    lines = []
    for before, after in pairwise(account.commands):
        ticks = 1
        if before.number is not None and after.number is not None and after.number > before.number:
            ticks = after.number - before.number
        most, step = _allowed(account, before.time, after.time)
        for name, was, now, limit, rate in zip(
            ("v", "omega"), (before.v, before.omega), (after.v, after.omega), most, step, strict=True
        ):
            if not math.isfinite(was) or not math.isfinite(now):
                continue
            room = ticks * rate * (1 + _ROUNDING) + _ROUNDING
            # A limit that was tightened is reached at slew.
            if abs(now) > max(limit * (1 + _ROUNDING) + _ROUNDING, abs(was)):
                lines.append(f"limits: {name} = {now:.6g} at {after.time:.3f}, the limit is {limit:g}")
            if abs(now - was) > room and not (now == 0.0 and _may_stop(account, after.time)):
                lines.append(
                    f"slew: {name} from {was:.6g} to {now:.6g} in {ticks} ticks at {after.time:.3f}, "
                    f"{room:.3g} allowed; mode {_mode(account, after.time)!r}"
                )
    return lines


def _of_zeros(account: Account) -> list[str]:
    lines = []
    for start, end, why in account.zero:
        moving = [entry for entry in account.commands if start < entry.time < end and (entry.v or entry.omega)]
        if moving:
            late = moving[0].time - start
            lines.append(f"zero: {moving[0].v:.4g}, {moving[0].omega:.4g} at {late:+.2f} s after the latest: {why}")
    return lines


def _of_gaps(account: Account) -> list[str]:
    lines = []
    for start, end in account.active:
        times = [start, *(entry.time for entry in account.commands if start < entry.time < end), end]
        worst = max((_due(account, before, after), before) for before, after in pairwise(times))
        if worst[0] > MOST_GAP:
            lines.append(f"gap: no command for {worst[0]:.2f} s from {worst[1]:.3f} on while active")
    return lines


def _due(account: Account, before: float, after: float) -> float:
    """Return the time in which ticks were due between two times [s]."""
    stood = sum(max(0.0, min(end, after) - max(start, before)) for start, end in account.stood)
    return after - before - stood


def _allowed(account: Account, before: float, now: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the widest limits that may have held between two commands."""
    starts = [entry.start for entry in account.allowed]
    first = max(bisect_right(starts, before - SLACK) - 1, 0)
    last = max(bisect_right(starts, now + SLACK), first + 1)
    inside = account.allowed[first:last]
    most = tuple(max(entry.most[i] for entry in inside) for i in (0, 1))
    step = tuple(max(entry.step[i] for entry in inside) for i in (0, 1))
    return most, step  # type: ignore[return-value]


def _may_stop(account: Account, now: float) -> bool:
    """Return True if zero at once is allowed: by the reported mode, or by request."""
    if any(abs(time - now) <= SLACK for time in account.requested):
        return True
    times = [time for time, _ in account.modes]
    near = account.modes[bisect_left(times, now - SLACK) : bisect_right(times, now + SLACK)]
    return any(mode.startswith(_AT_ONCE) for _, mode in near)


def _mode(account: Account, now: float) -> str:
    times = [time for time, _ in account.modes]
    place = bisect_right(times, now + SLACK) - 1
    return account.modes[place][1] if place >= 0 else ""
