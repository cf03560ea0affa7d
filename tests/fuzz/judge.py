"""Check the commands of a live node against the guarantees of docs/safety.md, without ROS.

Each command is a tick. Between ticks it changes by at most the larger of slew and braking limit times the
sample time. It may become zero immediately if the node reports STOPPED, FAULT, IDLE or FINISHED, or on request.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

from diffdrive_mpc import load_config

CONFIG = load_config("ssm")
SLACK = 0.35
"""Maximum difference of the times of an event in two processes, due to scheduling, discovery and delivery [s]."""
_ROUNDING = 1e-6
_STOPPED_MODES = ("STOPPED", "FAULT", "IDLE", "FINISHED")


@dataclass(frozen=True)
class ReceivedCommand:
    """Command with its time of arrival [s] and its sequence number."""

    time: float
    v: float
    omega: float
    number: int | None = None


@dataclass
class EventLog:
    """Events of a campaign; times are from the monotonic clock [s]."""

    commands: list[ReceivedCommand] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    requested: list[float] = field(default_factory=list)
    """Times at which the command may become zero immediately because of a request."""
    zero: list[tuple[float, float, str]] = field(default_factory=list)
    """Start and end of intervals in which the command is zero, and the reason."""


def faults(events: EventLog) -> list[str]:
    """Return a line for each violation."""
    lines = [f"not finite: {command}" for command in events.commands if not math.isfinite(command.v + command.omega)]
    lines += [line for before, after in pairwise(events.commands) for line in _faults_of_step(events, before, after)]
    for start, end, reason in events.zero:
        moving = [command for command in events.commands if start < command.time < end and (command.v or command.omega)]
        lines += (
            [f"zero: {moving[0]} at {moving[0].time - start:+.2f} s after the deadline: {reason}"] if moving else []
        )
    return lines


def _faults_of_step(events: EventLog, first: ReceivedCommand, second: ReceivedCommand) -> list[str]:
    limits, dt, lines = CONFIG.limits, CONFIG.sample_time, []
    ticks = max((second.number or 0) - (first.number or 0), 1)
    rates = max(limits.v_slew, limits.v_braking), max(limits.omega_slew, limits.omega_braking)
    for name, limit, rate in (("v", limits.v, rates[0]), ("omega", limits.omega, rates[1])):
        previous, current = getattr(first, name), getattr(second, name)
        if abs(current) > max(limit * (1 + _ROUNDING), abs(previous)):
            lines.append(f"limits: {name} = {current:.6g} at {second.time:.3f}, the limit is {limit:g}")
        change = ticks * rate * dt * (1 + _ROUNDING) + _ROUNDING
        if abs(current - previous) > change and not (current == 0.0 and _may_stop(events, second.time)):
            lines.append(f"slew: {name} from {previous:.6g} to {current:.6g} in {ticks} ticks at {second.time:.3f}")
    return lines


def _may_stop(events: EventLog, now: float) -> bool:
    """Return True if the reported mode or a request permits an immediate zero command."""
    times = [time for time, _ in events.modes]
    near_modes = events.modes[bisect_left(times, now - SLACK) : bisect_right(times, now + SLACK)]
    return any(abs(time - now) <= SLACK for time in events.requested) or any(
        mode.startswith(_STOPPED_MODES) for _, mode in near_modes
    )
