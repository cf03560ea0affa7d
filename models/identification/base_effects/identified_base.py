"""A robot with the effects of its base, as it was identified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.identification.base_effects.free_run import Point, free_run
from diffdrive_mpc.models.identification.base_effects.selection import Trial
from diffdrive_mpc.models.identification.base_effects.sensed import sensed
from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.fit import pooled_fit_percent
from diffdrive_mpc.models.identification.identified import IdentifiedModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record


@dataclass(frozen=True)
class IdentifiedBase:
    """A model with base effects, and the sensors that it was seen through.

    Attributes
    ----------
    identified
        The model: SM, with `base_effects` among its content. Its v is that of the encoders.
    effects
        Names of the effects found.
    trials
        What was tried, in this order.
    point
        Every parameter of the free run, sensors included.
    pose
        Delay of the poses, travel over encoders, and mount; None without enough poses.
    """

    identified: IdentifiedModel
    effects: tuple[str, ...]
    trials: tuple[Trial, ...]
    point: Point
    pose: Estimate | None

    def readings(self, records: Sequence[Record]) -> list[FloatArray]:
        """For each record (K, 3) v and omega of the encoders, omega of the gyro, from one free run over it."""
        return [free_run(self.point, stretch) for stretch in sensed(records)]

    def body_twists(self, records: Sequence[Record]) -> list[FloatArray]:
        """For each record (K, 2) true v [m/s] and yaw rate [rad/s] from one free run, without sensors' errors."""
        prompt = {name: value for name, value in self.point.items() if name != "encoders.lag"}
        prompt |= {"encoders.delay": 0.0, "gyro.offset": 0.0}
        travel = self.pose.value("pose.travel") if self.pose else 1.0
        twists = []
        for stretch in sensed(records):
            seen = free_run(prompt, stretch)
            twists.append(np.column_stack([travel * seen[:, 0], seen[:, 2]]))
        return twists

    def fit_percent(self, records: Sequence[Record]) -> FloatArray:
        """(3,) pooled FIT [%] of v and omega of the encoders, omega of the gyro; raises ValueError as `sensed`."""
        stretches = sensed(records)
        simulated = [free_run(self.point, stretch) for stretch in stretches]
        return np.array(
            [
                pooled_fit_percent(
                    [s.outputs[s.counts[:, row], row] for s in stretches],
                    [y[s.counts[:, row], row] for y, s in zip(simulated, stretches, strict=True)],
                )
                for row in range(3)
            ]
        )
