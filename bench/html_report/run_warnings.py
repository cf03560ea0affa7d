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

_LIMIT_TOLERANCE = 1e-6
"""Distance from the limit below which a command counts as at the limit [m/s, rad/s]."""
_MAX_MESSAGES = 3
"""Maximum number of messages in a warning."""


class Remedies(StrictModel):
    """Thresholds and remedies of the warnings; `remedies.yaml` describes each threshold."""

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
    """Load `remedies.yaml`."""
    return load_checked(Remedies, Path(__file__).parent / "remedies.yaml")


def run_warnings(run: Run, config: ControllerConfig | None = None, name: str = "") -> list[PageWarning]:
    """List the warnings about a run in descending order of severity.

    Parameters
    ----------
    run
        The run.
    config
        Configuration of the controller, which contains the limits; None for a peer.
    name
        Prefix of each warning if there are several runs.
    """
    settings = remedies()
    sentences = [
        (_incomplete(run), settings.not_completed),
        (_fallbacks(run, ("BRAKING", "STOPPED")), settings.waited),
        (_fallbacks(run, ("REUSED_PLAN",)), settings.fallback),
        (_missed_deadlines(run), settings.late),
        (_missing_poses(run, settings), settings.poses_lost),
        (_at_limit(run, config, settings), settings.at_limit),
        (_on_backend(run, config, settings), settings.backend),
        (_messages(run), settings.messages),
    ]
    prefix = f"{name}: " if name else ""
    return [PageWarning(prefix + sentence, remedy) for sentence, remedy in sentences if sentence]


def _incomplete(run: Run) -> str:
    if run.metrics.completed:
        return ""
    return f"The run did not complete: {run.ended or 'the robot was not near the end of its path in time'}."


def _fallbacks(run: Run, modes: Sequence[str]) -> str:
    """Describe the number of counted ticks in each of the `modes`, and the time of the first of these ticks."""
    ticks = zip(run.modes, run.time, run.counted, strict=True)
    entered = [(mode, t) for mode, t, counted in ticks if counted and mode in modes]
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


def _missing_poses(run: Run, thresholds: Remedies) -> str:
    arrived = run.time[np.isfinite(run.measured_pose[:, 0])]
    if len(arrived) < 3:
        return "" if len(arrived) or not len(run.time) else "No pose arrived."
    pauses = np.diff([*arrived, run.time[-1]])
    median_pause = float(np.median(pauses[:-1]))
    too_long = pauses > thresholds.pose_gap * median_pause
    if not too_long.any():
        return ""
    first = arrived[np.flatnonzero(too_long)[0]]
    return (
        f"Poses were missing {_times(int(too_long.sum()))}, for {pauses.max():.2f} s at most (usually one every "
        f"{median_pause:.2f} s), first at {first:.2f} s."
    )


def _at_limit(run: Run, config: ControllerConfig | None, thresholds: Remedies) -> str:
    if config is None:
        return ""
    command, demanded = run.command[run.counted], np.abs(run.reference_twist[run.counted])
    sides = (config.limits.v, config.limits.omega)
    limits = np.column_stack([sides_at(limit, column) for limit, column in zip(sides, command.T, strict=True)])
    command = np.abs(command)
    # Ticks at which the reference itself reaches the limit do not count.
    shares = 100.0 * np.mean((command >= limits - _LIMIT_TOLERANCE) & (demanded < limits - _LIMIT_TOLERANCE), axis=0)
    sentences = [
        f"{name} at {share:.0f} %"
        for name, share in zip(("v", "omega"), shares, strict=True)
        if share > thresholds.share_at_limit
    ]
    if not sentences:
        return ""
    return f"Commands are at their limit although the path demands less: {' and '.join(sentences)} of the ticks."


def _on_backend(run: Run, config: ControllerConfig | None, thresholds: Remedies) -> str:
    """Describe the share of ticks solved by a backend, unless the configuration demands a backend."""
    if config is not None and config.solver.method != "auto":
        return ""
    share = SolverShares.from_run(run).method_backend_percent
    return f"A backend had to solve {share:.0f} % of the ticks." if share > thresholds.share_on_backend else ""


def _messages(run: Run) -> str:
    messages = [message for message in dict.fromkeys(run.messages) if message]
    if not messages:
        return ""
    more = f" And {len(messages) - _MAX_MESSAGES} more." if len(messages) > _MAX_MESSAGES else ""
    return "The controller reported: " + " ".join(f"“{message}”" for message in messages[:_MAX_MESSAGES]) + more


def _ticks(count: int) -> str:
    return "1 tick" if count == 1 else f"{count} ticks"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
