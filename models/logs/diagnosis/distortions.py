"""Detection of sensors that lose a part of their signal: those without a sign, and encoders that saturate."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import ENCODERS, GYRO, Streams, fit_response
from diffdrive_mpc.models.logs.diagnosis.wheels import SIDES, commanded_sides
from diffdrive_mpc.models.logs.record import Finding


def check_rectified(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about sensors without a sign, which are removed from `streams`."""
    findings = []
    sides = None if streams.twist is None or streams.wheels is None else commanded_sides(streams)
    pairs: list[tuple[str, FloatArray, FloatArray | None]] = [(GYRO, streams.command[:, 1], streams.yaw_rate)]
    if sides is not None and streams.wheels is not None and streams.wheels.shape[1] == len(SIDES):
        pairs.append((ENCODERS, sides, streams.wheels))
    for name, command, values in pairs:
        if values is None or not (_both_signs(command, settings) and _one_sign(values, settings)):
            continue
        plain, sizes = (fit_response(streams, inputs, values, settings) for inputs in (command, np.abs(command)))
        if sizes is None or min(sizes.correlation) < settings.clear_correlation:
            continue
        if plain is not None and min(plain.correlation) > min(sizes.correlation):
            continue
        words = f"the readings of the {name} tell how fast, but never in which direction: record them with their sign"
        findings.append(Finding("rectified sensor", "error", log, words))
        if name == GYRO:
            streams.yaw_rate = None
        else:
            streams.twist = streams.wheels = None
    return findings


def _one_sign(values: FloatArray, settings: CheckSettings) -> bool:
    low, high = np.nanpercentile(values, [1, 99], axis=0)
    return bool((np.minimum(np.abs(low), np.abs(high)) < settings.never_negative * np.maximum(-low, high)).all())


def _both_signs(values: FloatArray, settings: CheckSettings) -> bool:
    low, high = np.nanpercentile(values, [5, 95], axis=0)
    return bool((np.minimum(-low, high) > settings.stuck_command * np.maximum(-low, high)).all())


def check_clipped_side(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the encoder of one side saturates although more is commanded."""
    if streams.twist is None or streams.wheels is None or streams.wheels.shape[1] != len(SIDES):
        return []
    sides = commanded_sides(streams)
    if sides is None:
        return []
    sizes = np.abs(streams.wheels)
    most = np.nanmax(sizes, axis=0)
    at_most = sizes >= most * (1 - 1e-9)
    share = np.nanmean(at_most, axis=0) / max(float(np.isfinite(sizes[:, 0]).mean()), 1e-9)
    side = int(np.argmax(share))
    if share[side] < settings.clipped_readings or share[1 - side] > 0.3 * share[side]:
        return []
    response = fit_response(streams, sides[:, side], streams.wheels[:, side], settings)
    if response is None:
        return []
    wanted = np.abs(streams.delayed(streams.lagged(sides[:, side], response.lag), response.dead_time))
    # The scale below the clip, by the side that ends nowhere.
    crossed = fit_response(streams, sides[:, 1 - side], streams.wheels[:, 1 - side], settings)
    scale = abs(float((crossed or response).gain[0, 0]))
    if float(np.nanmedian(wanted[at_most[:, side]])) * scale < settings.beyond_clip * most[side]:
        return []
    words = (
        f"the encoder of the {SIDES[side]} side never reads more than {most[side]:.3g} rad/s, in "
        f"{100 * share[side]:.0f} % of the rows exactly that, while more is asked for and the other side reads more: "
        "it is clipped; record with a wider range, or drive slower"
    )
    streams.twist = streams.wheels = None
    return [Finding("clipped sensor", "error", log, words)]
