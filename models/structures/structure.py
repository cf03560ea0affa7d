"""Interface of a structure of velocity models; one line in the registry adds a structure everywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from diffdrive_mpc.models.structures.model_file import ModelFile

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.record import Record
    from diffdrive_mpc.models.output_error.experiment import YawSource
    from diffdrive_mpc.models.structures.identified import IdentifiedModel
    from diffdrive_mpc.models.structures.orders import OrderChoice


@dataclass(frozen=True)
class IdentificationConditions:
    """Conditions of an identification, besides the training records.

    Attributes
    ----------
    validation
        Records held out, for tables; nothing is chosen by them.
    yaw
        Sensor whose omega the model predicts.
    order
        Order of the model, for structures that have a choice; None to choose it.
    wheel_radius
        [m]; None where the log has no wheel speeds.
    """

    validation: Sequence[Record] = ()
    yaw: YawSource = "gyro"
    order: int | None = None
    wheel_radius: float | None = None


class StructureFit(NamedTuple):
    """Fit of a structure to records."""

    identified: IdentifiedModel
    """The model."""
    orders: OrderChoice | None = None
    """The orders that were compared, for structures that have a choice."""


@dataclass(frozen=True)
class Structure:
    """Structure of a velocity model, with its identification.

    Attributes
    ----------
    name
        By which files, options and messages call it.
    file
        Schema of its parameter file, from which the model is built.
    identify
        From records to a model; it raises ValueError if they do not permit it.
    needs_wheels
        Whether it is identified from wheel speeds and a gyro.
    largest_order
        The choice of order is 1 to this; None for structures without a choice.
    takes_effects
        Whether `models.identification.effects` can identify the effects of a base around it.
    """

    name: str
    file: type[ModelFile]
    identify: Callable[[Sequence[Record], IdentificationConditions], StructureFit]
    needs_wheels: bool = False
    largest_order: int | None = None
    takes_effects: bool = False
