"""Interface of a structure of velocity models; structures are listed in the registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures.model_file import ModelFile

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.record import Record
    from diffdrive_mpc.models.output_error.experiment import YawSource
    from diffdrive_mpc.models.structures.identified import IdentifiedModel
    from diffdrive_mpc.models.structures.orders import OrderChoice


@dataclass(frozen=True)
class IdentificationConditions:
    """Conditions of an identification, in addition to the training records.

    Attributes
    ----------
    validation
        Validation records, for tables; they are not used for decisions.
    yaw
        Sensor whose omega the model predicts.
    order
        Order of the model, for structures without a fixed order; None to select it.
    wheel_radius
        Wheel radius [m]; None if the log has no wheel speeds.
    limits
        Limits of the base, as for `sm.identify_channels`.
    """

    validation: Sequence[Record] = ()
    yaw: YawSource = "gyro"
    order: int | None = None
    wheel_radius: float | None = None
    limits: bool | FloatArray = True


class StructureFit(NamedTuple):
    """Fit of a structure to records."""

    identified: IdentifiedModel
    """The model."""
    orders: OrderChoice | None = None
    """Comparison of orders; None for structures with a fixed order."""


@dataclass(frozen=True)
class Structure:
    """Structure of a velocity model, with its identification.

    Attributes
    ----------
    name
        Name in files, options and messages.
    file
        Schema of the parameter file, which also builds the model.
    identify
        Function that identifies the model from records; raises ValueError if they are unsuitable.
    needs_wheels
        True if the identification needs wheel speeds and a gyro.
    max_order
        Maximum order; None for structures with a fixed order.
    supports_effects
        True if `models.identification.effects` supports base effects for the structure.
    """

    name: str
    file: type[ModelFile]
    identify: Callable[[Sequence[Record], IdentificationConditions], StructureFit]
    needs_wheels: bool = False
    max_order: int | None = None
    supports_effects: bool = False
