"""Detection of distorted sensors: readings without a sign, and saturated encoders."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.check_settings import CheckSettings
from diffdrive_mpc.models.logs.diagnosis.streams import ENCODERS, GYRO, Streams, fit_response
from diffdrive_mpc.models.logs.diagnosis.wheels import SIDES, commanded_sides
from diffdrive_mpc.models.logs.record import Finding


def check_rectified(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return findings about sensors whose readings have no sign; remove these sensors from `streams`."""
    findings = []
    sides = commanded_sides(streams)
    pairs: list[tuple[str, FloatArray, FloatArray | None]] = [(GYRO, streams.command[:, 1], streams.yaw_rate)]
    if sides is not None and streams.wheels is not None and streams.wheels.shape[1] == len(SIDES):
        pairs.append((ENCODERS, sides, streams.wheels))
    for name, command, values in pairs:
        if values is None or not (_has_both_signs(command, settings) and _has_one_sign(values, settings)):
            continue
        signed, unsigned = (fit_response(streams, inputs, values, settings) for inputs in (command, np.abs(command)))
        if unsigned is None or min(unsigned.correlation) < settings.clear_correlation:
            continue
        # The magnitude of the command must explain the readings better than the command itself.
        if signed is not None and min(signed.correlation) > min(unsigned.correlation):
            continue
        message = f"the readings of the {name} have no sign: record them with the direction of motion"
        findings.append(Finding("rectified sensor", "error", log, message))
        if name == GYRO:
            streams.yaw_rate = None
        else:
            streams.twist = streams.wheels = None
    return findings


def _has_one_sign(values: FloatArray, settings: CheckSettings) -> bool:
    low, high = np.nanpercentile(values, [1, 99], axis=0)
    return bool((np.minimum(np.abs(low), np.abs(high)) < settings.negative_share * np.maximum(-low, high)).all())


def _has_both_signs(values: FloatArray, settings: CheckSettings) -> bool:
    low, high = np.nanpercentile(values, [5, 95], axis=0)
    return bool((np.minimum(-low, high) > settings.stuck_command * np.maximum(-low, high)).all())


def check_clipped_side(log: str, streams: Streams, settings: CheckSettings) -> list[Finding]:
    """Return at most one finding: the encoder of one side saturates below the commanded speed."""
    sides = commanded_sides(streams)
    if sides is None or streams.wheels is None or streams.wheels.shape[1] != len(SIDES):
        return []
    sizes = np.abs(streams.wheels)
    maximum = np.nanmax(sizes, axis=0)
    is_maximum = sizes >= maximum * (1 - 1e-9)
    share = np.nanmean(is_maximum, axis=0) / max(float(np.isfinite(sizes[:, 0]).mean()), 1e-9)
    side = int(np.argmax(share))
    # If both sides are often at their maximum, the cause is not a single encoder.
    if share[side] < settings.clipped_share or share[1 - side] > 0.3 * share[side]:
        return []
    response = fit_response(streams, sides[:, side], streams.wheels[:, side], settings)
    if response is None:
        return []
    commanded = np.abs(streams.delay(streams.low_pass(sides[:, side], response.lag), response.dead_time))
    # The other side does not saturate, so its gain is that of an unclipped_response encoder.
    unclipped_response = fit_response(streams, sides[:, 1 - side], streams.wheels[:, 1 - side], settings)
    scale = abs(float((unclipped_response or response).gain[0, 0]))
    if float(np.nanmedian(commanded[is_maximum[:, side]])) * scale < settings.clip_ratio * maximum[side]:
        return []
    message = (
        f"the encoder of the {SIDES[side]} side is clipped at {maximum[side]:.3g} rad/s in "
        f"{100 * share[side]:.0f} % of the rows, although higher speeds are commanded; record with a wider range or "
        "drive more slowly"
    )
    streams.twist = streams.wheels = None
    return [Finding("clipped sensor", "error", log, message)]
