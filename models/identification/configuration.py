"""A controller configuration for the identified robot, with a reason beside each value."""

from __future__ import annotations

import numpy as np

from diffdrive_mpc.models.identification.geometry import firmware_track
from diffdrive_mpc.models.identification.report import Outcome
from diffdrive_mpc.models.identification.settings import report_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS
from diffdrive_mpc.mpc.config.schema import Limits

MODEL_FILE = "model.yaml"
_UNITS = {"v": "m/s", "omega": "rad/s"}


def configuration(outcome: Outcome) -> str:
    """The text of `config.yaml`: the model beside it, limits that the log covers, and the tracks of the wheels.

    What a log cannot tell, such as the slew that the robot may be asked for, keeps the default and is named.
    """
    fitted, train = outcome.fitted, outcome.data.train
    asked = np.abs(np.concatenate([record.command for record in train]))
    limit, reason = np.empty(2), []
    for row, channel in enumerate(CHANNELS):
        found = fitted.identified.limits.get(channel)
        limit[row] = asked[:, row].max() if found is None else found
        reason.append("largest command of the log" if found is None else "where the robot clips it")
    gain = np.maximum(np.diag(fitted.identified.model.dc_gain), 1.0)
    predicted = report_settings().limit_margin * gain * limit
    lines = [
        f"# Controller of {outcome.name}. Fields left out keep the schema's default: diffdrive-mpc config schema",
        f"model: {MODEL_FILE}",
        f"sample_time: {train[0].dt:.6g}   # s, of the log: the period at which `step` is called",
        *_slew(outcome),
        *(f"  {name}: {limit[i]:.4g}   # {_UNITS[name]}, {reason[i]}" for i, name in enumerate(CHANNELS)),
        *(
            f"  predicted_{name}: {predicted[i]:.4g}   # {_UNITS[name]}, what the model makes of it, with a margin"
            for i, name in enumerate(CHANNELS)
        ),
        *_wheels(outcome, np.minimum(asked, limit)),
    ]
    return "\n".join(lines) + "\n"


def _slew(outcome: Outcome) -> list[str]:
    """Within the slopes that the base follows, where they were found, its linear model is exact."""
    found = outcome.fitted.identified.parameters
    known = [name for name in CHANNELS if f"slew.{name}" in found.names]
    if not known:
        return ["limits:   # v_slew and omega_slew are not in a log: set them if the robot must be driven more gently"]
    default, lines = Limits(), ["limits:"]
    for name in known:
        value, deviation = found.value(f"slew.{name}"), found.deviation(f"slew.{name}")
        # Two standard deviations less, so the base's own limit does not act; a slope hardly seen still allows half.
        slew = min(max(value - 2.0 * deviation, 0.5 * value), getattr(default, f"{name}_slew"))
        lines.append(f"  {name}_slew: {slew:.4g}   # {_UNITS[name]} per second, within what the base follows")
    return lines


def _wheels(outcome: Outcome, commands: FloatArray) -> list[str]:
    """Lines about the wheels, where the log has any; `commands` (K, 2) are the sizes the robot was driven with."""
    geometry = outcome.fitted.geometry
    track = None
    if geometry:
        track = firmware_track(outcome.data.train, geometry, outcome.fitted.identified.model.dc_gain)
    if geometry is None or track is None:
        return [
            "# Not in the log: limits.wheel_speed, wheels.track and wheels.encoder_track keep the default; set them."
        ]
    rim = report_settings().limit_margin * float((commands[:, 0] + 0.5 * track * commands[:, 1]).max())
    return [
        f"  wheel_speed: {rim:.4g}   # m/s at the rim, the fastest that the log asked of a side, with a margin",
        "wheels:",
        f"  track: {track:.4g}   # m, by which the robot turned omega_ref into wheel speeds",
        f"  encoder_track: {geometry.track:.4g}   # m, by which the log's omega was computed",
    ]
