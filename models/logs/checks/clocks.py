"""Whether all times of a log come from one clock."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.checks.settings import check_settings
from diffdrive_mpc.models.logs.record import Finding


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
