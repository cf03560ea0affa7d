"""Which order of a structure: each one compared on the data it was identified from and on data it was not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.output_error.validation import validate
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import ModelError

# An order is worth its states if it explains this much more [percentage points of FIT, mean of both channels].
_WORTH = 0.25
_FLOOR = 1


@dataclass(frozen=True)
class OrderRow:
    """One order.

    Attributes
    ----------
    identified
        The model.
    parameters
        How many numbers were free.
    train_fit_percent, validation_fit_percent
        (2,) of v and omega [%]; the second None without validation records.
    aic, bic
        Akaike's and Schwarz's information criteria over the lowest of all orders, counted in effective samples.
    """

    identified: IdentifiedModel
    parameters: int
    train_fit_percent: FloatArray
    validation_fit_percent: FloatArray | None
    aic: float
    bic: float


@dataclass(frozen=True)
class OrderChoice:
    """All orders, the chosen one, and why."""

    rows: tuple[OrderRow, ...]
    order: int
    reason: str

    @property
    def identified(self) -> IdentifiedModel:
        """The model of the chosen order."""
        return self.rows[self.order - 1].identified


def compare_orders(
    models: Sequence[IdentifiedModel], train: Sequence[Record], validation: Sequence[Record], yaw: YawSource
) -> OrderChoice:
    """Choose among models of order 1, 2 and so on.

    With validation records: the lowest order whose mean FIT there comes within a quarter of a percentage point of the
    best. Without: the lowest Schwarz criterion. Order 1 is a floor for the comparison and never chosen; nor is an order
    whose model cannot be a robot's.

    Parameters
    ----------
    models
        One of each order, identified from `train`.
    train, validation
        Records identified from, and records held out.
    yaw
        Which sensor's omega the models predict.

    Raises
    ------
    ValueError
        If no order gives a usable model.
    """
    criteria = _criteria(models)
    rows = tuple(
        OrderRow(
            identified,
            len(identified.fits[0].parameters),
            validate(identified.system, train, yaw).fit_percent,
            validate(identified.system, validation, yaw).fit_percent if validation else None,
            *criterion,
        )
        for identified, criterion in zip(models, criteria, strict=True)
    )
    usable = [order for order, row in enumerate(rows, start=1) if order > _FLOOR and _is_robot(row.identified)]
    if not usable:
        name = models[0].structure.upper()
        raise ValueError(f"no order of {name} gives a model that could be a robot's: identify SM, or use a longer log")
    if validation:
        score = {order: float(np.mean(_held_out(rows[order - 1]))) for order in usable}
        best = max(score.values())
        order = min(order for order in usable if score[order] > best - _WORTH)
        return OrderChoice(
            rows, order, f"lowest order within {_WORTH} points of the best mean validation FIT, {best:.2f} %"
        )
    order = min(usable, key=lambda order: rows[order - 1].bic)
    return OrderChoice(rows, order, "lowest Schwarz criterion; no records were held out")


def _criteria(models: Sequence[IdentifiedModel]) -> list[tuple[float, float]]:
    """AIC and BIC of each model over the lowest; the residuals' scale and correlation are those of the largest."""
    reference = models[-1].fits[0]
    samples = reference.effective_samples
    criteria = []
    for model in models:
        fit = model.fits[0]
        misfit = float(samples @ np.log(fit.loss(reference.scale)))
        count = len(fit.parameters)
        criteria.append((misfit + 2 * count, misfit + np.log(samples.sum()) * count))
    lowest = np.min(criteria, axis=0)
    return [(float(aic - lowest[0]), float(bic - lowest[1])) for aic, bic in criteria]


def _held_out(row: OrderRow) -> FloatArray:
    assert row.validation_fit_percent is not None
    return row.validation_fit_percent


def _is_robot(identified: IdentifiedModel) -> bool:
    try:
        return identified.model.order > 0
    except ModelError:
        return False
