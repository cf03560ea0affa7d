"""Kinds of YAML files with their shipped files, and the JSON Schemas of three of them."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.models.file_kind import PACKAGE, FileKind
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.plug_ins import plug_ins

SCHEMAS = {
    "controller": PACKAGE / "mpc" / "schemas" / "controller.schema.json",
    "model": PACKAGE / "models" / "schemas" / "model.schema.json",
    "trajectory": PACKAGE / "mpc" / "schemas" / "trajectory.schema.json",
}
"""Place of each JSON Schema, by the name of the kind. A schema is in the room of its reader, so that shipped files name
it by the same relative path in a clone and in an installed wheel."""


def _kind(name: str, folder: str) -> FileKind:
    return FileKind(name, PACKAGE / folder)


def _configurations() -> tuple[Path, ...]:
    """Return the configurations that packages bring with their structures."""
    return tuple(structure.config for structure in function_structures().values() if structure.config)


def _models() -> FileKind:
    elsewhere: tuple[Path, ...] = tuple(
        structure.shipped for structure in function_structures().values() if structure.shipped
    )
    patterns = ("*.yaml", "robots/*.yaml")
    return FileKind("model", PACKAGE / "models" / "parameters", patterns, ("robot.yaml",), elsewhere)


KINDS: dict[str, FileKind] = {
    kind.name: kind
    for kind in (
        FileKind("controller", PACKAGE / "mpc" / "config" / "parameters", elsewhere=_configurations()),
        _kind("trajectory", "mpc/trajectories/built_in"),
        _models(),
        _kind("mapping", "models/logs/mappings"),
        _kind("stated-robot", "models/stated_robots.yaml"),
        _kind("robot", "sim/plants/robots.yaml"),
        _kind("surface", "sim/plants/surfaces.yaml"),
        _kind("sensors", "sim/sensing/sensor_sets.yaml"),
        _kind("scenario", "sim/disturbances/scenarios.yaml"),
        *plug_ins("files"),
    )
}
"""By name."""
