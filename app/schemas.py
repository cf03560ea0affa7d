"""JSON Schemas of controller, model and trajectory files, derived from the classes that read these files.

`python -m diffdrive_mpc.app.schemas` writes the schemas to the clone, or to the copy of the package in the folder that
is given as argument. A wheel contains the schemas.
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
"""Path of the JSON Schema by kind of file. A schema is in the folder of the package that reads the file, so that its
path relative to a built-in file is the same in a clone and in an installed wheel."""


def json_schema(kind: str) -> str:
    """Return the JSON Schema of a kind of file as text, with the structures of installed packages.

    Raise ConfigError if the kind is unknown.
    """
    if kind not in SCHEMAS:
        raise ConfigError(f"--json: there is no schema of '{kind}'; use {', '.join(SCHEMAS)}")
    return json.dumps(_reject_other_keys(_SCHEMAS[kind]()), indent=2) + "\n"


def write_all(package: Path = PACKAGE) -> None:
    """Write every schema to the package, or to a copy of the package; raise OSError if a file cannot be written."""
    for kind, place in SCHEMAS.items():
        file = package / place.relative_to(PACKAGE)
        file.parent.mkdir(exist_ok=True)
        file.write_text(json_schema(kind), encoding="utf-8")


def _reject_other_keys(node: Any) -> Any:  # noqa: ANN401 - any part of a schema
    """Add `additionalProperties: false` to objects with patterns, because the readers reject unmatched keys."""
    if isinstance(node, Mapping):
        entries = {key: _reject_other_keys(entry) for key, entry in node.items()}
        return {"additionalProperties": False, **entries} if "patternProperties" in node else entries
    return [_reject_other_keys(entry) for entry in node] if isinstance(node, list) else node


def _controllers() -> Schema:
    """Split each group into keys for users and keys for experts."""
    complete = ControllerConfig.model_json_schema()
    groups = complete["$defs"]
    sections: tuple[Schema, Schema] = ({}, {})
    for name, field in complete["properties"].items():
        reference = field.get("$ref") or next((part["$ref"] for part in field.get("allOf", ()) if "$ref" in part), None)
        if reference is None:
            sections[not is_for_users(name)][name] = field
            continue
        group = groups[reference.rsplit("/", 1)[-1]]
        for section, for_users in zip(sections, (True, False), strict=True):
            keys = {
                key: part for key, part in group["properties"].items() if is_for_users(f"{name}.{key}") == for_users
            }
            if keys:
                section[name] = {**group, "properties": keys}
    expert = {"type": "object", "title": "For experts", "additionalProperties": False, "properties": sections[1]}
    return {**complete, "properties": sections[0] | {EXPERT: expert}}


def _models() -> Schema:
    functions = (structure.schema() for structure in function_structures().values())
    files: list[Any] = [*(structure.file for structure in STRUCTURES.values()), *functions]
    return {"title": "Velocity model", **TypeAdapter(reduce(or_, files)).json_schema()}


def _trajectories() -> Schema:
    return {"title": "Trajectory", **TypeAdapter(SegmentFile | WaypointFile).json_schema()}


_SCHEMAS: dict[str, Callable[[], Schema]] = {"controller": _controllers, "model": _models, "trajectory": _trajectories}

if __name__ == "__main__":
    write_all(*map(Path, sys.argv[1:]))
