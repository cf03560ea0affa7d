"""What a controller was told at each tick beside the readings themselves: stamps, covariances, and what was sent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.logs.drive_log.tick import TOLD, measured_cells


def told_columns(measurements: Sequence[Measurement], count: int) -> dict[str, FloatArray]:
    """Columns (count,) by the names of `TOLD`, NaN where nothing was said; `measurements` may be empty."""
    rows = [measured_cells(measurement) for measurement in measurements] or [{}] * count
    return {name: np.array([row.get(name, np.nan) for row in rows], dtype=float) for name in TOLD}
