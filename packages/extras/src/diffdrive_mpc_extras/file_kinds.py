"""Kinds of files of this package, with their shipped files."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.models.file_kind import FileKind

_PACKAGE = Path(__file__).parent

DRIVE = FileKind("drive", _PACKAGE / "turn_costs" / "drives")
TERRAIN = FileKind("terrain", _PACKAGE / "terrain" / "terrains")
TURN_COSTS = FileKind("turn-costs", _PACKAGE / "turn_costs" / "floors")
VEHICLE = FileKind("vehicle", _PACKAGE / "turn_costs" / "vehicles")
WORLD = FileKind("world", _PACKAGE / "worlds" / "shipped")
