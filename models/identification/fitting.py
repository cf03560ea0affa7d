"""The one place where records become a model, whatever its structure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.effects import IdentifiedBase, identify_with_effects
from diffdrive_mpc.models.identification.geometry import WheelGeometry, wheel_geometry
from diffdrive_mpc.models.identification.log_data import Data
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.validation import Validation, score, simulate_records
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.orders import OrderChoice
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.ssm import LARGEST_ORDER, choose_order


@dataclass(frozen=True)
class Fitted:
    """A model, and how well a free simulation of it explains the records.

    Attributes
    ----------
    identified
        The model.
    orders
        The orders of SSM compared; None for the other structures.
    base
        The same model with what its base does around it; None where that was not asked for.
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
    base: IdentifiedBase | None
    geometry: WheelGeometry | None
    train: Validation
    validation: Validation
    simulated: tuple[FloatArray, ...]
    seconds: float


def fit(
    data: Data,
    structure: str,
    order: int | None = None,
    *,
    effects: bool = False,
    on_trial: Callable[[str], None] | None = None,
) -> Fitted:
    """Identify a model and try it on the records held out.

    Parameters
    ----------
    data
        The records.
    structure
        "mbm", "sm" or "ssm".
    order
        Of an SSM; None to choose it.
    effects
        Whether to look for what the base does around an SM.
    on_trial
        Called with the name of each effect that is tried.

    Raises
    ------
    ValueError
        If the records do not allow it; ModelError, a kind of it, if the numbers found cannot be a robot's.
    """
    geometry = wheel_geometry(data.train)
    orders: OrderChoice | None = None
    base: IdentifiedBase | None = None
    started = perf_counter()
    if effects:
        base = _with_effects(data, geometry, on_trial)
        identified = base.identified
    elif structure == "ssm":
        orders = _orders(data, order)
        identified = orders.identified
    else:
        identified = _sm_or_mbm(data, structure, geometry)
    seconds = perf_counter() - started
    _ = identified.model  # refuses what cannot be a robot
    simulated = [_simulated(identified, base, records) for records in (data.train, data.validation)]
    train, validation = (
        _scored(outputs, records, identified, name)
        for outputs, records, name in zip(
            simulated, (data.train, data.validation), ("training", "validation"), strict=True
        )
    )
    return Fitted(identified, orders, base, geometry, train, validation, tuple(simulated[1]), seconds)


def _sm_or_mbm(data: Data, structure: str, geometry: WheelGeometry | None) -> IdentifiedModel:
    if structure == "sm":
        return identify_sm(data.train, yaw=data.yaw)
    if geometry is None or data.yaw != "gyro":
        raise ConfigError("mbm: it needs wheel speeds and a gyro in the log; map them, or identify sm or ssm")
    return identify_mbm(data.train, geometry.radius)


def _orders(data: Data, order: int | None) -> OrderChoice:
    # Order 1 is only a floor to compare with, so at least order 2 is tried beside it.
    choice = choose_order(data.train, data.validation, largest=max(order or LARGEST_ORDER, 2), yaw=data.yaw)
    return choice if order is None else replace(choice, order=order, reason="as asked for")


def _with_effects(data: Data, geometry: WheelGeometry | None, on_trial: Callable[[str], None] | None) -> IdentifiedBase:
    if data.yaw != "gyro":
        raise ConfigError("--effects: they are told apart by a gyro beside the encoders; map one, or leave it out")
    return identify_with_effects(data.train, encoder_track=geometry.track if geometry else None, on_trial=on_trial)


def _simulated(identified: IdentifiedModel, base: IdentifiedBase | None, records: Sequence[Record]) -> list[FloatArray]:
    """Speed of the encoders and omega as the model means it, from one free run over each record."""
    if base is None:
        return simulate_records(identified.system, records, identified.yaw)
    return [readings[:, [0, 2]] for readings in base.readings(records)]


def _scored(
    simulated: Sequence[FloatArray], records: Sequence[Record], identified: IdentifiedModel, name: str
) -> Validation:
    try:
        return score(simulated, twist_experiments(records, identified.yaw))
    except ValueError as error:
        raise ConfigError(f"{name} records: {error}") from error
