"""Whether the robot takes its commands only up to a level of its own."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import COMMAND, POSE, Streams, answer, paired
from diffdrive_mpc.models.logs.record import Finding
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = ("m/s", "rad/s")


def check_clipping(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Notes on channels whose answer grows with the command only up to a level."""
    findings = []
    for channel in (0, 1):
        command = streams.channel(COMMAND, channel)
        names = [name for name in streams.present(channel) if name != POSE]
        if command is None or not names:
            continue
        values = streams.channel(names[-1], channel)
        assert values is not None
        size = np.abs(command[np.isfinite(command)])
        plain = answer(streams, command, values, settings)
        if plain is None or plain.correlation[0] < settings.clear_correlation:
            continue
        best, level = float(plain.correlation[0]), np.inf
        for bound in np.unique(np.percentile(size[size > 0], np.arange(10, 91, 5))):
            behind = streams.lagged(np.clip(command, -bound, bound), plain.lag)
            correlation = float(np.corrcoef(*paired(behind, values, round(plain.dead_time / streams.dt)))[0, 1])
            if correlation > best:
                best, level = correlation, float(bound)
        above = float(np.mean(size > level))
        left = (1 - best**2) / max(1 - float(plain.correlation[0]) ** 2, 1e-12)
        if above > settings.clipped_share and left < settings.clipped_rest:
            words = (
                f"{CHANNELS[channel]} grows with its command only up to about {level:.2g} {_UNITS[channel]}: "
                "the robot clips it; "
                "the limit is identified with the model"
            )
            findings.append(Finding("clipped response", "note", log, words))
    return findings
