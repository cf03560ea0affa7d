"""Text lines about the limits of the base: limits that the log reaches, with intervals, and limits not reached."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.base_effects import KINDS
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.input_limits import side_name
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS

_UNITS = {"v": "m/s", "omega": "rad/s"}
_SPEEDS = 2
"""Number of kinds of limits that are speeds; the kinds after them are rates."""


def limit_lines(identified: IdentifiedModel, records: Sequence[Record]) -> list[str]:
    """Return a line with a 95 % interval for each limit found, and one line for the sides that are not reached."""
    commands, reached, missing = np.concatenate([record.command for record in records]), [], []
    for row, channel in enumerate(CHANNELS):
        largest = np.maximum([commands[:, row].max(), -commands[:, row].min()], 0.0)
        for kind in range(len(KINDS)):
            side, is_speed = side_name(channel, kind), kind < _SPEEDS
            unit = _UNITS[channel] if is_speed else f"{_UNITS[channel]}^2"
            both = f"{channel}.limit" if is_speed else f"slew.{channel}"
            name = next((name for name in (f"{channel}.{side}", both) if name in identified.parameters.names), None)
            if name is not None:
                value, half = identified.parameters.value(name), 1.96 * identified.parameters.deviation(name)
                low, high = max(value - half, 0.0), value + half
                word = "limit" if is_speed else "rate"
                reached.append(f"{channel} {side}: {word} of {value:.3g} {unit} ({low:.3g} to {high:.3g})")
            else:
                missing.append(f"{channel} {side}" + (f" (driven to {largest[kind]:.3g} {unit})" if is_speed else ""))
    return [*reached, *([f"not reached in this log: {', '.join(missing)}"] if missing else [])]
