"""JSON Schemas of controller, model and trajectory files, derived from the classes that read them.

`python -m diffdrive_mpc.app.schemas` writes the schemas into the clone; with a folder as argument, into the copy of the
package in this folder. A wheel contains the schemas.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.mpc.config.rooms import EXPERT, is_for_users
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.segments import SegmentFile
from diffdrive_mpc.mpc.trajectories.waypoints import WaypointFile

Schema = dict[str, Any]
PACKAGE = Path(__file__).parents[1]
SCHEMAS = {
    "controller": PACKAGE / "mpc" / "schemas" / "controller.schema.json",
    "model": PACKAGE / "models" / "schemas" / "model.schema.json",
    "trajectory": PACKAGE / "mpc" / "schemas" / "trajectory.schema.json",
}
"""Path of each JSON Schema by the kind of file. A schema is in the folder of the module that reads the file, so that
shipped files refer to it by the same relative path in a clone and in an installed wheel."""


def json_schema(kind: str) -> str:
    """Return the JSON Schema of a kind of file as text, including the structures of installed packages.

    Raises ConfigError if there is no such schema.
    """
    if kind not in SCHEMAS:
        raise ConfigError(f"--json: there is no schema of '{kind}'; give {', '.join(SCHEMAS)}")
    return json.dumps(_reject_other_keys(_SCHEMAS[kind]()), indent=2) + "\n"


def write_all(package: Path = PACKAGE) -> None:
    """Write every schema into the package, or into a copy of it; raise OSError if a file cannot be written."""
    for kind, place in SCHEMAS.items():
        file = package / place.relative_to(PACKAGE)
        file.parent.mkdir(exist_ok=True)
        file.write_text(json_schema(kind), encoding="utf-8")


def _reject_other_keys(node: Any) -> Any:  # noqa: ANN401 - any part of a schema
    """Add `additionalProperties: false` to objects with patterns, because the readers reject unmatched keys."""
    if isinstance(node, Mapping):
        inside = {key: _reject_other_keys(inner) for key, inner in node.items()}
        return {"additionalProperties": False, **inside} if "patternProperties" in node else inside
    return [_reject_other_keys(inner) for inner in node] if isinstance(node, list) else node


def _controllers() -> Schema:
    """Split each group into its keys for users and its keys for experts."""
    whole = ControllerConfig.model_json_schema()
    groups = whole["$defs"]
    rooms: tuple[Schema, Schema] = ({}, {})
    for name, field in whole["properties"].items():
        reference = field.get("$ref") or next((part["$ref"] for part in field.get("allOf", ()) if "$ref" in part), None)
        if reference is None:
            rooms[not is_for_users(name)][name] = field
            continue
        group = groups[reference.rsplit("/", 1)[-1]]
        for room, is_wanted in zip(rooms, (True, False), strict=True):
            keys = {
                key: part for key, part in group["properties"].items() if is_for_users(f"{name}.{key}") == is_wanted
            }
            if keys:
                room[name] = {**group, "properties": keys}
    expert = {"type": "object", "title": "For experts", "additionalProperties": False, "properties": rooms[1]}
    return {**whole, "properties": rooms[0] | {EXPERT: expert}}


def _models() -> Schema:
    functions = (structure.schema() for structure in function_structures().values())
    files: list[Any] = [*(structure.file for structure in STRUCTURES.values()), *functions]
    return {"title": "Velocity model", **TypeAdapter(reduce(or_, files)).json_schema()}


def _trajectories() -> Schema:
    return {"title": "Trajectory", **TypeAdapter(SegmentFile | WaypointFile).json_schema()}


_SCHEMAS: dict[str, Callable[[], Schema]] = {"controller": _controllers, "model": _models, "trajectory": _trajectories}

if __name__ == "__main__":
    write_all(*map(Path, sys.argv[1:]))
