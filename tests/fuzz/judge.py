"""Check the commands of a live node against the promises of docs/safety.md; needs no ROS.

Each command is a tick. Between ticks it changes by at most slew, or braking, times the sample time. It may become
zero at once if the node reports STOPPED, FAULT or IDLE, or by request.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

from diffdrive_mpc import load_config

CONFIG = load_config("ssm")
SLACK = 0.35
"""Difference between the times that two processes note for one event: scheduling, discovery, delivery [s]."""
_ROUNDING = 1e-6
_AT_ONCE = ("STOPPED", "FAULT", "IDLE", "FINISHED")


@dataclass(frozen=True)
class Heard:
    """A command as it arrived."""

    time: float
    v: float
    omega: float
    number: int | None = None


@dataclass
class Account:
    """Events of a campaign, by the monotonic clock [s]."""

    commands: list[Heard] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    requested: list[float] = field(default_factory=list)
    """Times at which the command may become zero at once by request."""
    zero: list[tuple[float, float, str]] = field(default_factory=list)
    """Start and end of intervals in which the command is zero, and the reason."""


def faults(account: Account) -> list[str]:
    """Return a line for each broken promise."""
    lines = [f"not finite: {heard}" for heard in account.commands if not (math.isfinite(heard.v + heard.omega))]
    lines += [line for before, after in pairwise(account.commands) for line in _faults_of_step(account, before, after)]
    for start, end, reason in account.zero:
        moving = [heard for heard in account.commands if start < heard.time < end and (heard.v or heard.omega)]
        lines += [f"zero: {moving[0]} at {moving[0].time - start:+.2f} s after the latest: {reason}"] if moving else []
    return lines


def _faults_of_step(account: Account, before: Heard, after: Heard) -> list[str]:
    limits, dt, lines = CONFIG.limits, CONFIG.sample_time, []
    ticks = max((after.number or 0) - (before.number or 0), 1)
    rates = max(limits.v_slew, limits.v_braking), max(limits.omega_slew, limits.omega_braking)
    for name, most, rate in (("v", limits.v, rates[0]), ("omega", limits.omega, rates[1])):
        past, now = getattr(before, name), getattr(after, name)
        if abs(now) > max(most * (1 + _ROUNDING), abs(past)):
            lines.append(f"limits: {name} = {now:.6g} at {after.time:.3f}, the limit is {most:g}")
        change = ticks * rate * dt * (1 + _ROUNDING) + _ROUNDING
        if abs(now - past) > change and not (now == 0.0 and _may_stop(account, after.time)):
            lines.append(f"slew: {name} from {past:.6g} to {now:.6g} in {ticks} ticks at {after.time:.3f}")
    return lines


def _may_stop(account: Account, now: float) -> bool:
    """Return True if zero at once is allowed: by the reported mode, or by request."""
    times = [time for time, _ in account.modes]
    near = account.modes[bisect_left(times, now - SLACK) : bisect_right(times, now + SLACK)]
    return any(abs(time - now) <= SLACK for time in account.requested) or any(
        mode.startswith(_AT_ONCE) for _, mode in near
    )
