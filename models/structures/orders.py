"""Selection of the order of a structure by comparison on held-out blocks of the training data.

Validation records are not used for the selection, because this would bias their score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import (
    SampledExperiment,
    YawSource,
    join_experiments,
    twist_experiments,
)
from diffdrive_mpc.models.output_error.held_out import hold_out
from diffdrive_mpc.models.output_error.settings import estimator_settings
from diffdrive_mpc.models.output_error.solve import OutputErrorFit
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import ModelError

# Minimum increase of FIT that justifies a higher order [percentage points, mean of both channels].
_MIN_INCREASE = 0.25
_BASELINE = 1
_ROUNDING = 1e-3
# Maximum loss of a channel against a simpler model [percentage points of FIT].
_MAX_LOSS = 0.1


@dataclass(frozen=True)
class OrderRow:
    """Model and scores of one order.

    Attributes
    ----------
    identified
        The model.
    parameters
        Number of free parameters.
    train_fit_percent, block_fit_percent, validation_fit_percent
        (2,) FIT of v and omega [%] on training records, on held-out blocks of the training records, and on validation
        records. Models for held-out blocks are fitted without the block. Block FIT is None for order 1, if an order is
        requested, and if the records are too short; validation FIT is None if there are no validation records.
    aic, bic
        Akaike's and Schwarz's information criteria relative to their minimum over all orders, by effective samples.
    """

    identified: IdentifiedModel
    parameters: int
    train_fit_percent: FloatArray
    block_fit_percent: FloatArray | None
    validation_fit_percent: FloatArray | None
    aic: float
    bic: float


@dataclass(frozen=True)
class OrderChoice:
    """Comparison of orders, with the selected order and the reason."""

    rows: tuple[OrderRow, ...]
    order: int
    reason: str

    @property
    def identified(self) -> IdentifiedModel:
        """The model of the selected order."""
        return self.rows[self.order - 1].identified


def compare_orders(
    models: Sequence[IdentifiedModel],
    train: Sequence[Record],
    validation: Sequence[Record],
    yaw: YawSource,
    *,
    requested: int | None = None,
    floor: FloatArray | None = None,
) -> OrderChoice:
    """Select the order among models of order 1, 2 and so on.

    The result is the lowest order with a mean FIT on held-out blocks within a quarter of a percentage point of the
    maximum. If the records are too short for blocks, it is the order with the lowest Schwarz criterion. Order 1, which
    is a baseline, and orders whose model cannot describe a robot are never selected. Orders with poorly determined
    parameters are avoided, because their delay is uncertain.

    Parameters
    ----------
    models
        One model for each order, identified from `train`.
    train, validation
        Training records, and validation records, which are scored but not used for the selection.
    yaw
        Sensor whose omega the models predict.
    requested
        Order to use; None to select it.
    floor
        (2,) FIT of a simpler model on `train` [%]; orders with a lower FIT (see `is_behind`) are avoided.

    Raises
    ------
    ValueError
        If no order gives a usable model.
    """
    criteria = _criteria(models)
    held_out: list[FloatArray | None] = [None] * len(models)
    if not requested:
        experiments = join_experiments(twist_experiments(train, yaw))
        held_out[_BASELINE:] = [block_fit(model.fits[0], experiments) for model in models[_BASELINE:]]
    rows = tuple(
        OrderRow(
            identified,
            len(identified.fits[0].parameters),
            validate(identified.system, train, yaw).fit_percent,
            blocks,
            validate(identified.system, validation, yaw).fit_percent if validation else None,
            *criterion,
        )
        for identified, blocks, criterion in zip(models, held_out, criteria, strict=True)
    )
    if requested:
        return OrderChoice(rows, requested, "as requested")
    usable = [order for order, row in enumerate(rows, start=1) if order > _BASELINE and _can_drive(row.identified)]
    if not usable:
        name = models[0].structure.upper()
        raise ValueError(
            f"no order of {name} gives a model that can describe a robot: identify SM, or use a longer log"
        )
    # Each filter is skipped if no order passes it.
    limit = estimator_settings().warn.condition
    usable = [order for order in usable if rows[order - 1].identified.fits[0].sandwich.condition < limit] or usable
    if floor is not None:
        usable = [order for order in usable if not is_behind(rows[order - 1].train_fit_percent, floor)] or usable
    score = {order: float(np.mean(fit)) for order in usable if (fit := rows[order - 1].block_fit_percent) is not None}
    if score:
        best = max(score.values())
        order = min(order for order in score if score[order] > best - _MIN_INCREASE)
        reason = f"lowest order within {_MIN_INCREASE} points of the best mean FIT on held-out blocks, {best:.2f} %"
        return OrderChoice(rows, order, reason)
    order = min(usable, key=lambda order: rows[order - 1].bic)
    return OrderChoice(rows, order, "lowest Schwarz criterion; the records are too short to hold blocks out")


def is_behind(fit_percent: FloatArray, floor: FloatArray) -> bool:
    """Return True if FIT (2,) [%] is below `floor` (2,) [%] on average, or by more than 0.1 in one channel."""
    difference = fit_percent - floor
    return bool(difference.mean() < -_ROUNDING or difference.min() < -_MAX_LOSS)


def block_fit(fit: OutputErrorFit, experiments: Sequence[SampledExperiment]) -> FloatArray | None:
    """Return FIT (p,) [%] on held-out blocks of joined experiments; None if they are too short."""
    try:
        powers = hold_out(fit, experiments, brief=True, fixed_weights=True).powers
    except ValueError:
        return None
    return np.asarray(100.0 * (1.0 - np.sqrt(powers.mean(axis=0)) / output_spread(experiments)))


def _criteria(models: Sequence[IdentifiedModel]) -> list[tuple[float, float]]:
    """Compute AIC and BIC relative to their minima, with the residual scale and correlation of the highest order."""
    # Residuals of low orders contain unmodelled dynamics, which would appear as correlated noise.
    reference = models[-1].fits[0]
    samples = reference.sandwich.effective_samples
    criteria = []
    for model in models:
        fit = model.fits[0]
        misfit = float(samples @ np.log(fit.loss(reference.scale)))
        count = len(fit.parameters)
        criteria.append((misfit + 2 * count, misfit + np.log(samples.sum()) * count))
    minima = np.min(criteria, axis=0)
    return [(float(aic - minima[0]), float(bic - minima[1])) for aic, bic in criteria]


def _can_drive(identified: IdentifiedModel) -> bool:
    try:
        return identified.model.order > 0
    except ModelError:
        return False
