"""What is wrong with a log as a whole, before anything is fitted: one cause, one sentence, one remedy.

Every rule looks at streams as the rules before it have mended them, so that one fault is told once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.logs.check_settings import CheckSettings, check_settings
from diffdrive_mpc.models.logs.diagnosis.agreement import check_parts, compare, relations
from diffdrive_mpc.models.logs.diagnosis.clipping import check_clipping
from diffdrive_mpc.models.logs.diagnosis.scales import check_axes, check_presence, check_signs, check_units
from diffdrive_mpc.models.logs.diagnosis.shifts import check_shifts
from diffdrive_mpc.models.logs.diagnosis.streams import Streams, streams_of
from diffdrive_mpc.models.logs.diagnosis.wheels import check_wheels
from diffdrive_mpc.models.logs.record import Finding, Log, Record

__all__ = ["compare_logs", "diagnose"]


def diagnose(log: str, records: Sequence[Record], settings: CheckSettings) -> list[Finding]:
    """Findings about how commands and sensors of one log fit together.

    Parameters
    ----------
    log
        Its name.
    records
        Its stretches.
    settings
        The thresholds.
    """
    streams = streams_of(records, settings)
    findings = check_presence(log, streams)
    if not _long_enough(streams, settings):
        return findings
    findings += check_wheels(log, streams, settings)
    findings += check_axes(log, streams, settings)
    findings += check_signs(log, streams, settings)
    findings += check_units(log, streams, settings)
    findings += check_parts(log, streams, settings)
    findings += check_shifts(log, streams, settings)
    findings += check_clipping(log, streams, settings)
    return findings


def _long_enough(streams: Streams, settings: CheckSettings) -> bool:
    """Whether the commands change often enough, in long enough a time, for answers to be told from chance."""
    samples = int(np.isfinite(streams.command[:, 0]).sum())
    return samples * streams.dt >= settings.shortest_drive


def compare_logs(logs: Sequence[Log]) -> list[Finding]:
    """Findings about logs that are to be used together and do not look like drives of one robot."""
    settings = check_settings()
    sound = [log for log in logs if not any(finding.severity == "error" for finding in log.findings)]
    if len(sound) < 2:
        return []
    known = [relations(streams_of(log.records, settings), settings) for log in sound]
    findings: list[Finding] = []
    for log, other in zip(sound[1:], known[1:], strict=True):
        findings += compare(sound[0].name, log.name, known[0], other, settings)
    return findings
