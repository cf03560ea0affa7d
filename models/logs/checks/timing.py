"""Gaps and jitter."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.logs.checks.settings import CheckSettings
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.logs.signals import RawLog


def gap_finding(log: str, end: float, start: float, settings: CheckSettings) -> Finding:
    """The finding for a pause of the log from `end` to `start` [s]."""
    place = f"{log}, {end:.1f} to {start:.1f} s"
    if start - end > settings.clock_jump:
        words = f"time jumps by {start - end:.0f} s: were two clocks written into one column? A new stretch begins"
        return Finding("two clocks", "warning", place, words, (end, start))
    return Finding("gap", "note", place, f"no data for {start - end:.3f} s; a new stretch begins", (end, start))


def check_timing(raw: RawLog, period: float, settings: CheckSettings) -> list[Finding]:
    """A finding where the log's clock, of `period` [s], ticks unevenly."""
    steps = np.concatenate([np.diff(stretch.clock) for stretch in raw.stretches])
    starts = np.concatenate([stretch.clock[:-1] for stretch in raw.stretches])
    inside = steps <= settings.longest_step(period)
    if not inside.any():
        return []
    deviation = np.abs(steps[inside] - period)
    typical = float(np.percentile(deviation, 95))
    if typical <= settings.jitter * period:
        return []
    worst = float(starts[inside][np.argmax(deviation)])
    words = (
        f"steps of the clock deviate by up to {typical:.4f} s (95 %) from {period:.4g} s, most at {worst:.1f} s; "
        "dead times will be smeared by as much"
    )
    return [Finding("jitter", "warning", raw.name, words, (worst, worst))]
