"""Warnings about a closed-loop run and their remedies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.html_report.page import PageWarning
from diffdrive_mpc.bench.run_row import SolverShares
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.two_sided import sides_at
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.sim import Run

_SAME = 1e-6
"""Distance from the limit below which a command counts as at the limit [m/s, rad/s]."""
_SHOWN = 3


class Remedies(StrictModel):
    """Thresholds and remedies of the warnings; see the file."""

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
    """Load the remedies of this package."""
    return load_checked(Remedies, Path(__file__).parent / "remedies.yaml")


def run_warnings(run: Run, config: ControllerConfig | None = None, name: str = "") -> list[PageWarning]:
    """List the warnings about a run in descending order of severity.

    Parameters
    ----------
    run
        The run.
    config
        Configuration of the controller, for the limits; None for a peer.
    name
        Prefix of each warning if there are several runs.
    """
    remedies_of_kinds = remedies()
    sentences = [
        (_incomplete(run), remedies_of_kinds.not_completed),
        (_fallbacks(run, ("BRAKING", "STOPPED")), remedies_of_kinds.waited),
        (_fallbacks(run, ("REUSED_PLAN",)), remedies_of_kinds.fallback),
        (_missed_deadlines(run), remedies_of_kinds.late),
        (_missing_poses(run, remedies_of_kinds), remedies_of_kinds.poses_lost),
        (_at_limit(run, config, remedies_of_kinds), remedies_of_kinds.at_limit),
        (_on_backend(run, config, remedies_of_kinds), remedies_of_kinds.backend),
        (_messages(run), remedies_of_kinds.messages),
    ]
    prefix = f"{name}: " if name else ""
    return [PageWarning(prefix + sentence, remedy) for sentence, remedy in sentences if sentence]


def _incomplete(run: Run) -> str:
    if run.metrics.completed:
        return ""
    return f"The run did not complete: {run.ended or 'the robot was not near the end of its path in time'}."


def _fallbacks(run: Run, modes: Sequence[str]) -> str:
    """Describe the number of counted ticks in one of the `modes`, and the time of the first of these ticks."""
    entered = [
        (mode, t)
        for mode, t, counted in zip(run.modes, run.time, run.counted, strict=True)
        if counted and mode in modes
    ]
    if not entered:
        return ""
    counts = Counter(mode for mode, _ in entered)
    counted_modes = ", ".join(f"{mode} at {_ticks(count)}" for mode, count in counts.items())
    return f"The controller had no fresh plan: {counted_modes}, first at {entered[0][1]:.2f} s."


def _missed_deadlines(run: Run) -> str:
    misses = run.metrics.deadline_misses
    if not misses:
        return ""
    max_time, sample = 1e3 * run.metrics.step_time_max_s, 1e3 * run.sample_time
    return f"{_ticks(misses)} took longer than the sample time of {sample:.1f} ms; the maximum was {max_time:.1f} ms."


def _missing_poses(run: Run, remedy: Remedies) -> str:
    arrived = run.time[np.isfinite(run.measured_pose[:, 0])]
    if len(arrived) < 3:
        return "" if len(arrived) or not len(run.time) else "No pose arrived."
    pauses = np.diff([*arrived, run.time[-1]])
    median_pause = float(np.median(pauses[:-1]))
    too_long = pauses > remedy.pose_gap * median_pause
    if not too_long.any():
        return ""
    first = arrived[np.flatnonzero(too_long)[0]]
    return (
        f"Poses were missing {_times(int(too_long.sum()))}, for {pauses.max():.2f} s at most (usually one every "
        f"{median_pause:.2f} s), first at {first:.2f} s."
    )


def _at_limit(run: Run, config: ControllerConfig | None, remedy: Remedies) -> str:
    if config is None:
        return ""
    command, demanded = run.command[run.counted], np.abs(run.reference_twist[run.counted])
    sides = (config.limits.v, config.limits.omega)
    limits = np.column_stack([sides_at(limit, column) for limit, column in zip(sides, command.T, strict=True)])
    command = np.abs(command)
    # No warning for ticks at which the path itself demands the limit.
    shares = 100.0 * np.mean((command >= limits - _SAME) & (demanded < limits - _SAME), axis=0)
    sentences = [
        f"{name} at {share:.0f} %"
        for name, share in zip(("v", "omega"), shares, strict=True)
        if share > remedy.share_at_limit
    ]
    return (
        f"Commands are at their limit although the path demands less: {' and '.join(sentences)} of the ticks."
        if sentences
        else ""
    )


def _on_backend(run: Run, config: ControllerConfig | None, remedy: Remedies) -> str:
    """Describe the share of ticks solved by a backend, unless the configuration demands a backend."""
    if config is not None and config.solver.method != "auto":
        return ""
    share = SolverShares.of_run(run).method_backend_percent
    return f"A backend had to solve {share:.0f} % of the ticks." if share > remedy.share_on_backend else ""


def _messages(run: Run) -> str:
    messages = [message for message in dict.fromkeys(run.messages) if message]
    if not messages:
        return ""
    more = f" And {len(messages) - _SHOWN} more." if len(messages) > _SHOWN else ""
    return "The controller reported: " + " ".join(f"“{message}”" for message in messages[:_SHOWN]) + more


def _ticks(count: int) -> str:
    return "1 tick" if count == 1 else f"{count} ticks"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
