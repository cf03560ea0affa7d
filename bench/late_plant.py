"""A plant that hears every command some ticks later than it would: a dead time that no controller was told of."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.sim import Plant
from diffdrive_mpc.sim.plants.plant import PlantAround


class LatePlant(PlantAround):
    """`plant` behind a line that holds every command for `ticks` samples; see `sim.plants.plant.Plant`."""

    def __init__(self, plant: Plant, ticks: int) -> None:
        super().__init__(plant)
        self._ticks = ticks
        self._under_way: deque[FloatArray] = deque()

    def reset(self, pose: ArrayLike) -> None:
        """Reset the plant, with nothing under way."""
        self._plant.reset(pose)
        self._under_way = deque(np.zeros(2) for _ in range(self._ticks))

    def measure(self) -> Measurement:
        """What the plant's sensors delivered; as sent counts what entered the line."""
        measurement = self._plant.measure()
        if measurement.sent is None or not self._under_way:
            return measurement
        v, omega = self._under_way[-1].tolist()
        return replace(measurement, sent=(v, omega))

    def advance(self, command: ArrayLike) -> None:
        """Put `command` (2,) into the line, and let the plant go on with what leaves it."""
        self._under_way.append(np.array(command, dtype=float))
        self._plant.advance(self._under_way.popleft())
