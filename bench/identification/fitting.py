"""The one place where records become a model, whatever its structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

from bench.identification.data import Data
from bench.identification.geometry import WheelGeometry, wheel_geometry
from models.checked_yaml import ConfigError
from models.identification.identified import IdentifiedModel
from models.identification.mbm import identify_mbm
from models.identification.order import OrderChoice, choose_order
from models.identification.sm import identify_sm
from models.identification.ssm import LARGEST_ORDER
from models.identification.validation import Validation, simulate_records, validate
from models.interface import FloatArray
from models.logs import Record


@dataclass(frozen=True)
class Fitted:
    """A model, and how well a free simulation of it explains the records.

    Attributes
    ----------
    identified
        The model.
    orders
        The orders of SSM compared; None for the other structures.
    geometry
        Wheel radius and track of the log; None without wheel speeds.
    train, validation
        FIT, RMSE and residuals on either set.
    simulated
        For each validation record (K, 2) v [m/s] and omega [rad/s], sensor offsets included.
    seconds
        How long the estimation took [s], without reading, validation and figures.
    """

    identified: IdentifiedModel
    orders: OrderChoice | None
    geometry: WheelGeometry | None
    train: Validation
    validation: Validation
    simulated: tuple[FloatArray, ...]
    seconds: float


def fit(data: Data, structure: str, order: int | None) -> Fitted:
    """Identify a model and try it on the records held out.

    Parameters
    ----------
    data
        The records.
    structure
        "mbm", "sm" or "ssm".
    order
        Of an SSM; None to choose it.

    Raises
    ------
    ValueError
        If the records do not allow it; ModelError, a kind of it, if the numbers found cannot be a robot's.
    """
    geometry = wheel_geometry(data.train)
    started = perf_counter()
    identified, orders = _estimate(data, structure, order, geometry)
    seconds = perf_counter() - started
    _ = identified.model  # refuses what cannot be a robot
    system = identified.system
    return Fitted(
        identified,
        orders,
        geometry,
        _validated(identified, data.train, "training"),
        _validated(identified, data.validation, "validation"),
        tuple(simulate_records(system, data.validation, identified.yaw)),
        seconds,
    )


def _estimate(
    data: Data, structure: str, order: int | None, geometry: WheelGeometry | None
) -> tuple[IdentifiedModel, OrderChoice | None]:
    if structure == "sm":
        return identify_sm(data.train, yaw=data.yaw), None
    if structure == "mbm":
        if geometry is None or data.yaw != "gyro":
            raise ConfigError("mbm: it needs wheel speeds and a gyro in the log; map them, or identify sm or ssm")
        return identify_mbm(data.train, geometry.radius), None
    # Order 1 is only a floor to compare with, so at least order 2 is tried beside it.
    choice = choose_order(data.train, data.validation, largest=max(order or LARGEST_ORDER, 2), yaw=data.yaw)
    if order is not None:
        choice = replace(choice, order=order, reason="as asked for")
    return choice.identified, choice


def _validated(identified: IdentifiedModel, records: Sequence[Record], name: str) -> Validation:
    try:
        return validate(identified.system, records, identified.yaw)
    except ValueError as error:
        raise ConfigError(f"{name} records: {error}") from error
