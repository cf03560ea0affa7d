"""What in a closed-loop run needs attention, in words, each with what to do about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.html_report.page import Warned
from diffdrive_mpc.bench.run_row import SolverShares
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.two_sided import sides_at
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.sim import Run

_SAME = 1e-6
"""A command this close to its limit [m/s, rad/s] is at it."""
_SHOWN = 3


class Remedies(StrictModel):
    """Thresholds of the warnings, and what is to be done about each; see the file."""

    share_at_limit: float
    share_on_backend: float
    pose_gap: float
    not_completed: str
    late: str
    fallback: str
    waited: str
    at_limit: str
    backend: str
    poses_lost: str
    messages: str


@cache
def remedies() -> Remedies:
    """The shipped ones."""
    return load_checked(Remedies, Path(__file__).parent / "remedies.yaml")


def run_warnings(run: Run, config: ControllerConfig | None = None, name: str = "") -> list[Warned]:
    """Everything that a person should look at, the gravest first.

    Parameters
    ----------
    run
        The run.
    config
        Of its controller, for the limits; None for a peer.
    name
        What each warning begins with where there are several runs.
    """
    of = remedies()
    warned = [
        (_not_completed(run), of.not_completed),
        (_modes(run, ("BRAKING", "STOPPED")), of.waited),
        (_modes(run, ("REUSED_PLAN",)), of.fallback),
        (_late(run), of.late),
        (_poses_lost(run, of), of.poses_lost),
        (_at_limit(run, config, of), of.at_limit),
        (_on_backend(run, config, of), of.backend),
        (_said(run), of.messages),
    ]
    before = f"{name}: " if name else ""
    return [Warned(before + what, remedy) for what, remedy in warned if what]


def _not_completed(run: Run) -> str:
    if run.metrics.completed:
        return ""
    return f"The run did not complete: {run.ended or 'the robot was not near the end of its path in time'}."


def _modes(run: Run, asked: Sequence[str]) -> str:
    """At how many counted ticks it was in which of the modes that are asked for, and since when."""
    entered = [
        (mode, t) for mode, t, one in zip(run.modes, run.time, run.counted, strict=True) if one and mode in asked
    ]
    if not entered:
        return ""
    counts = Counter(mode for mode, _ in entered)
    counted_modes = ", ".join(f"{mode} at {_ticks(count)}" for mode, count in counts.items())
    return f"The controller did without a fresh plan: {counted_modes}, first at {entered[0][1]:.2f} s."


def _late(run: Run) -> str:
    misses = run.metrics.deadline_misses
    if not misses:
        return ""
    worst, sample = 1e3 * run.metrics.step_time_max_s, 1e3 * run.sample_time
    return f"{_ticks(misses)} took longer than the sample time of {sample:.1f} ms; the longest {worst:.1f} ms."


def _poses_lost(run: Run, of: Remedies) -> str:
    arrived = run.time[np.isfinite(run.measured_pose[:, 0])]
    if len(arrived) < 3:
        return "" if len(arrived) or not len(run.time) else "No pose arrived at all."
    pauses = np.diff([*arrived, run.time[-1]])
    usual = float(np.median(pauses[:-1]))
    long = pauses > of.pose_gap * usual
    if not long.any():
        return ""
    first = arrived[np.flatnonzero(long)[0]]
    return (
        f"Poses failed to come {_times(int(long.sum()))}, for {pauses.max():.2f} s at most (usually one every "
        f"{usual:.2f} s), first at {first:.2f} s."
    )


def _at_limit(run: Run, config: ControllerConfig | None, of: Remedies) -> str:
    if config is None:
        return ""
    command, asked = run.command[run.counted], np.abs(run.reference_twist[run.counted])
    sides = (config.limits.v, config.limits.omega)
    limits = np.column_stack([sides_at(limit, column) for limit, column in zip(sides, command.T, strict=True)])
    command = np.abs(command)
    # A path that asks for the limit itself is driven at the limit.
    shares = 100.0 * np.mean((command >= limits - _SAME) & (asked < limits - _SAME), axis=0)
    sentences = [
        f"{name} at {share:.0f} %"
        for name, share in zip(("v", "omega"), shares, strict=True)
        if share > of.share_at_limit
    ]
    return (
        f"Commands are at their limit though the path asks for less: {' and '.join(sentences)} of the ticks."
        if sentences
        else ""
    )


def _on_backend(run: Run, config: ControllerConfig | None, of: Remedies) -> str:
    """Where it was not chosen."""
    if config is not None and config.solver.method != "auto":
        return ""
    share = SolverShares.of(run).method_backend_percent
    return f"A backend had to solve {share:.0f} % of the ticks." if share > of.share_on_backend else ""


def _said(run: Run) -> str:
    messages = [message for message in dict.fromkeys(run.messages) if message]
    if not messages:
        return ""
    more = f" And {len(messages) - _SHOWN} more." if len(messages) > _SHOWN else ""
    return "The controller said: " + " ".join(f"“{message}”" for message in messages[:_SHOWN]) + more


def _ticks(count: int) -> str:
    return "1 tick" if count == 1 else f"{count} ticks"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
