"""Whether all times of a log come from one clock, and how evenly it ticks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings, check_settings
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.logs.sampling import RawLog


def require_one_clock(log: str, late: Mapping[str, FloatArray], remedy: str) -> None:
    """Raise ConfigError if two sources of a log have different clocks.

    Parameters
    ----------
    log
        Name of the log.
    late
        How much later than its stamp each reading was received or written [s], (n,) by the name of its source; NaN
        where unknown.
    remedy
        What the user can do.
    """
    offsets = {source: float(np.nanmedian(values)) for source, values in late.items() if np.isfinite(values).any()}
    if not offsets:
        return
    first, last = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
    apart = offsets[last] - offsets[first]
    if apart > check_settings().clock_offset:
        raise ConfigError(
            f"{log}: two clocks: the times of {first} are {apart:.3f} s ahead of those of {last}; {remedy}"
        )


def drifting_clocks(log: str, late: Mapping[str, FloatArray]) -> list[Finding]:
    """Findings for the sources whose stamps wander against the time of receipt; `late` as for `require_one_clock`."""
    findings = []
    for source, values in late.items():
        spread = float(np.ptp(np.percentile(values, [5, 95])))
        if spread > check_settings().clock_spread:
            words = (
                f"stamps wander by {spread:.3f} s against the time of receipt: a clock drifts, or messages queue up; "
                "dead times will be smeared by as much"
            )
            findings.append(Finding("clock drift", "warning", f"{log}, {source}", words))
    return findings


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
