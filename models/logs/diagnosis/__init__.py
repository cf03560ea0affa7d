"""Diagnosis of a log before a fit, with one finding and one remedy for each cause.

Each rule checks the streams after the corrections by earlier rules, so each fault is reported once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from textwrap import wrap

import numpy as np

from diffdrive_mpc.models.logs.check_settings import CheckSettings, check_settings
from diffdrive_mpc.models.logs.diagnosis import scales
from diffdrive_mpc.models.logs.diagnosis.agreement import check_jumps, check_parts, check_turning, compare, relations
from diffdrive_mpc.models.logs.diagnosis.commands import check_curve, check_echo, check_latch, check_rounding
from diffdrive_mpc.models.logs.diagnosis.distortions import check_clipped_side, check_rectified
from diffdrive_mpc.models.logs.diagnosis.motions import check_motions, compare_sensors
from diffdrive_mpc.models.logs.diagnosis.ramps import check_ramps
from diffdrive_mpc.models.logs.diagnosis.shifts import check_shifts
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, GYRO, Streams, fit_response, steady_gain
from diffdrive_mpc.models.logs.diagnosis.wheels import check_counts, check_order, check_wheels
from diffdrive_mpc.models.logs.record import Finding, Log, Record
from diffdrive_mpc.models.logs.record_checks import UNITS, check_excitation, command_changes
from diffdrive_mpc.models.velocity_model import CHANNELS

__all__ = ["compare_logs", "diagnose", "summary"]


def diagnose(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about contradictions between commands and sensors of one log.

    Parameters
    ----------
    log
        Name of the log.
    streams
        Streams of the log; they are not modified.
    settings
        The thresholds.
    """
    streams = replace(streams)  # a copy, because the rules replace its arrays
    findings = scales.check_presence(log, streams)
    # A short log does not distinguish responses from chance.
    duration = np.isfinite(streams.command[:, 0]).sum() * streams.dt
    if duration < settings.min_duration:
        message = f"{duration:.1f} s do not suffice to compare the streams; record {settings.min_duration:g} s or more"
        return [*findings, Finding("little excitation", "warning", log, message)]
    findings += scales.check_heading_unit(log, streams, settings)
    findings += check_counts(log, streams, settings)
    findings += scales.check_swap(log, streams, settings)
    if change := check_order(log, streams, settings) or check_jumps(log, streams, settings):
        return [*findings, *change]  # the parts before and after the change contradict each other in all later checks
    if echo := check_echo(log, streams, settings):
        return [*findings, *echo]
    findings += check_rectified(log, streams, settings)
    findings += check_clipped_side(log, streams, settings)
    # Check the encoders first, because their faults would also appear as wrong axes, signs or units.
    findings += check_wheels(log, streams, settings)
    if latch := check_latch(log, streams, settings):
        return [*findings, *latch]
    findings += scales.check_axes(log, streams, settings)
    findings += scales.check_signs(log, streams, settings)
    findings += scales.check_units(log, streams, settings)
    # Gains and shifts can only be compared after signs and units have been corrected.
    findings += check_parts(log, streams, settings)
    findings += check_shifts(log, streams, settings)
    findings += check_turning(log, streams, settings) or check_motions(log, streams, settings)
    findings += check_curve(log, streams, settings)
    findings += check_rounding(log, streams, settings)
    findings += check_ramps(log, streams, settings)
    return findings


def compare_logs(logs: Sequence[Log]) -> list[Finding]:
    """Compare logs that are used for one model; return findings about little excitation and different robots."""
    settings = check_settings()
    findings = check_excitation(", ".join(log.name for log in logs), [r for log in logs for r in log.records], settings)
    valid_logs = [log for log in logs if not log.errors]
    known = [relations(log.streams, settings) for log in valid_logs] if len(valid_logs) > 1 else []
    for log, log_relations in zip(valid_logs[1:], known[1:], strict=True):
        findings += compare(valid_logs[0].name, log.name, known[0], log_relations, settings)
    return findings


def summary(log: Log) -> list[str]:
    """Summarise a log in lines of 78 columns: streams, times, commands, responses, and a comparison of the sensors."""
    settings = check_settings()
    records = log.records
    dt = records[0].dt
    streams = log.streams
    rates = {"command": 1 / dt}
    for name, mask in (("encoders", "fresh_twist"), ("gyro", "fresh_yaw_rate"), ("pose", "fresh_pose")):
        fresh = [getattr(record, mask) for record in records if getattr(record, mask) is not None]
        if fresh:
            rates[name] = float(np.mean(np.concatenate(fresh))) / dt
    entries = [
        f"{name} {rate:.3g} Hz" + (f" ({log.sources[name]})" if name in log.sources else "")
        for name, rate in rates.items()
    ]
    duration = sum(len(record.command) for record in records) * dt
    stretches = "1 stretch" if len(records) == 1 else f"{len(records)} stretches"
    texts = {
        "streams": ", ".join(entries),
        "time": f"{records[0].start:.1f} to {records[-1].end:.1f} s, with {duration:.0f} s in {stretches}, "
        f"one sample every {dt:.4g} s",
        "commands": "; ".join(_command_summary(records, channel, settings) for channel in (0, 1)),
    } | {CHANNELS[channel]: _response_summary(streams, channel, settings) for channel in (0, 1)}
    for entry in compare_sensors(streams, settings):
        texts[entry.motion] = f"{texts[entry.motion]}; {entry}" if entry.motion in texts else str(entry)
    return [line for head, text in texts.items() for line in wrap(f"{head:10}{text}", 78, subsequent_indent=10 * " ")]


def _command_summary(records: Sequence[Record], channel: int, settings: CheckSettings) -> str:
    values = np.concatenate([record.command[:, channel] for record in records])
    changes = command_changes(records, channel, settings)
    return f"{CHANNELS[channel]} {values.min():.3g} to {values.max():.3g} {UNITS[CHANNELS[channel]]}, {changes} changes"


def _response_summary(streams: Streams, channel: int, settings: CheckSettings) -> str:
    """Describe the response of a channel's sensors to its command."""
    lines = []
    for name in streams.sensors(channel):
        response = fit_response(streams, *streams.pair(COMMAND, name, channel), settings)
        if response is None:
            lines.append(f"{name} not driven")
            continue
        # At a constant rate, the offset of a gyro cannot be separated from its gain.
        fits = [
            steady_gain(streams, name, channel, response.dead_time, settings, has_offset=has_offset)
            for has_offset in ((True, False) if name == GYRO else (False,))
        ]
        gain, interval = min(fits, key=lambda fit: fit[1])
        times = f"{gain:.3f} +- {interval:.3f} times, {response.delay:.2f} s later"
        # With such an interval, the delay is arbitrary as well.
        times = times if interval < 0.5 * abs(gain) else "not determined"
        lines.append(f"{name} {times}, correlation {response.correlation[0]:.2f}")
    needed = "encoders or poses" if channel == 0 else "encoders, gyro or poses"
    return "command -> " + "; ".join(lines) if lines else f"no sensor; identify needs {needed}"
