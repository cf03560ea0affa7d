"""Whether effects of the base are worth it: held against the plain model on blocks that neither was made from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffdrive_mpc.models.identification.effects.base import IdentifiedBase
from diffdrive_mpc.models.identification.effects.free_run import free_run, sensed
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import joined, twist_experiments
from diffdrive_mpc.models.output_error.held_out import blocks, cut, hold_out
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS


def loses(base: IdentifiedBase, plain: IdentifiedModel, records: Sequence[Record]) -> str | None:
    """A sentence if `base` predicts held-out blocks of `records` worse than `plain`, an SM from the same; else None.

    Raises
    ------
    ValueError
        If the records are too short to hold blocks out.
    """
    experiments, settings = joined(twist_experiments(records, plain.yaw)), effect_settings()
    measured = joined(sensed(records, plain.yaw))
    powers: list[FloatArray] = []
    for row in range(2):
        channel = [experiment.channel(row, row) for experiment in experiments]
        powers.append(hold_out(plain.fits[row], channel).powers[:, 0])
    with_effects = []
    for (_, block), point in zip(blocks(measured), base.points, strict=True):
        errors = [(free_run(point, part) - part.readings)[:, [0, -1]] for part in cut(measured, block)]
        with_effects.append(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    rms = np.sqrt([np.mean(powers, axis=1), np.mean(with_effects, axis=0)])
    fits = 100.0 * (1.0 - rms / output_spread(experiments))
    gained = fits[1] - fits[0]
    if gained.min() > -settings.most_lost and gained.mean() > 0.0:
        return None
    shown = ", ".join(f"{name} {a:.1f} to {b:.1f} %" for name, a, b in zip(CHANNELS, *fits, strict=True))
    effects = ", ".join(base.effects) or "a delay of the encoders"
    return f"effects ({effects}) predict held-out blocks no better than the plain model, FIT {shown}: left out"
