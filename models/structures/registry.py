"""Registry of the structures of velocity models; a new structure needs a schema, an identification and an entry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from diffdrive_mpc.models.structures.model_file import MbmFile, MbmModesFile, SmFile, SsmFile, TwoDelaysFile
from diffdrive_mpc.models.structures.structure import IdentificationConditions, Structure, StructureFit

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.record import Record

MAX_ORDER = 5
"""Maximum order of SSM."""


def _identify_by(module: str, records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Identify with a module of this package; it is imported on demand, because loading a model does not need it."""
    identified: StructureFit = import_module(f"{__package__}.{module}").identify(records, conditions)
    return identified


_ALL = (
    Structure("mbm", MbmFile, partial(_identify_by, "mbm"), needs_wheels=True),
    Structure("sm", SmFile, partial(_identify_by, "sm"), supports_effects=True),
    Structure("ssm", SsmFile, partial(_identify_by, "ssm"), max_order=MAX_ORDER),
    Structure("two_delays", TwoDelaysFile, partial(_identify_by, "two_delays")),
    Structure("mbm_modes", MbmModesFile, partial(_identify_by, "mbm_modes"), needs_wheels=True),
)
STRUCTURES: Mapping[str, Structure] = {structure.name: structure for structure in _ALL}
"""Structures by name, in the order of tables."""
