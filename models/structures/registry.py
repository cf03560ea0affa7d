"""All structures of velocity models: a new one is its own file and a line here."""

from __future__ import annotations

from collections.abc import Mapping

from diffdrive_mpc.models.structures.mbm import MBM
from diffdrive_mpc.models.structures.sm import SM
from diffdrive_mpc.models.structures.ssm import SSM
from diffdrive_mpc.models.structures.structure import Structure

STRUCTURES: Mapping[str, Structure] = {structure.name: structure for structure in (MBM, SM, SSM)}
"""By name, in the order of tables."""
