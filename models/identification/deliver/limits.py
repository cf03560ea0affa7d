"""Description of the limits of the base: limits that the log reaches, with intervals, and the other limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.input_limits import side_name
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = {"v": "m/s", "omega": "rad/s"}
_SPEED_KINDS = 2
"""Number of kinds of limits that are speeds; the remaining kinds are rates."""


def limit_lines(identified: IdentifiedModel, records: Sequence[Record]) -> list[str]:
    """Return a line with a 95 % interval for each identified limit, and one line for limits that are not reached."""
    commands, reached, missing = np.concatenate([record.command for record in records]), [], []
    for row, channel in enumerate(CHANNELS):
        peak = np.maximum([commands[:, row].max(), -commands[:, row].min()], 0.0)
        for kind in range(len(KINDS)):
            side, is_speed = side_name(channel, kind), kind < _SPEED_KINDS
            unit = _UNITS[channel] if is_speed else f"{_UNITS[channel]}^2"
            symmetric_name = f"{channel}.limit" if is_speed else f"slew.{channel}"
            names = (f"{channel}.{side}", symmetric_name)
            name = next((name for name in names if name in identified.parameters.names), None)
            if name is not None:
                value, half_width = identified.parameters.value(name), 1.96 * identified.parameters.deviation(name)
                low, high = max(value - half_width, 0.0), value + half_width
                quantity = "limit" if is_speed else "rate"
                reached.append(f"{channel} {side}: {quantity} of {value:.3g} {unit} ({low:.3g} to {high:.3g})")
            else:
                missing.append(f"{channel} {side}" + (f" (command up to {peak[kind]:.3g} {unit})" if is_speed else ""))
    return [*reached, *([f"not reached in this log: {', '.join(missing)}"] if missing else [])]
