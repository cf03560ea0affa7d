"""The JSON Schemas, made from what reads the files.

`python -m diffdrive_mpc.app.schemas.generate` writes them where they belong, in a clone; with a folder, into that copy
of our package: a wheel brings them.
"""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter

from diffdrive_mpc.app.command_line.file_kinds import KINDS
from diffdrive_mpc.app.tune.tune_file import TunePlan
from diffdrive_mpc.bench.experiment_file import ExperimentFile
from diffdrive_mpc.models.file_kind import PACKAGE, FileKind
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.plug_ins import known_packages
from diffdrive_mpc.models.stated_robot import MakersRobot
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.mpc.config.rooms import EXPERT, is_for_users
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.trajectories.segments import SegmentFile
from diffdrive_mpc.mpc.trajectories.waypoints import WaypointFile
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, SimulatedRobot, digital_twin
from diffdrive_mpc.sim.plants.surface import Surface
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet, load_sensor_set
from diffdrive_mpc_extras.campaign.campaign_file import CONDITION, Campaign
from diffdrive_mpc_extras.campaign.conditions import Conditions
from diffdrive_mpc_extras.campaign.definition import FACTORS_OF_A_CASE, GROUPS
from diffdrive_mpc_extras.campaign.draws import KINDS as DRAWS
from diffdrive_mpc_extras.proof.proof_file import Proof
from diffdrive_mpc_extras.turn_costs import TurnCosts
from diffdrive_mpc_extras.turn_costs.vehicle import DriveConstants, Vehicle
from diffdrive_mpc_extras.worlds.settings import world_settings
from diffdrive_mpc_extras.worlds.world import World
from diffdrive_mpc_monitor.rules import Rules

# JSON Schemas of files that say less, or other things, than the whole that they stand for.


Schema = dict[str, Any]
_ONE_OF = "one_of"


def only_what_differs(whole: Schema, base: Mapping[str, Any]) -> Schema:
    """Schema of a file that is laid over `base`: as `models.checked_yaml.laid_over`, group by group.

    What `base` has may be left out; anything that takes the place of a value as a whole is as in `whole`.
    """
    return without_unused({**_partial(whole, base, whole.get("$defs", {})), "$defs": whole.get("$defs", {})})


def _partial(node: Schema, base: Mapping[str, Any], defs: Mapping[str, Schema]) -> Schema:
    resolved = copy.deepcopy(_object_of(node, defs))
    if "properties" not in resolved:
        return node
    required = [name for name in resolved.pop("required", []) if name not in base]
    properties = {
        name: _partial(inner, base[name], defs) if isinstance(base.get(name), Mapping) else inner
        for name, inner in resolved["properties"].items()
    }
    kept = {key: node[key] for key in ("title", "description") if key in node}
    return resolved | kept | {"properties": properties} | ({"required": required} if required else {})


def _object_of(node: Schema, defs: Mapping[str, Schema]) -> Schema:
    """The schema of a group, behind its name and beside null."""
    if "$ref" in node:
        return defs[node["$ref"].rpartition("/")[2]]
    if "anyOf" in node:
        return next(_object_of(branch, defs) for branch in node["anyOf"] if branch.get("type") != "null")
    return node


def with_draws(whole: Schema) -> Schema:
    """Schema of a file in which any value may be drawn: as `sim.disturbances.drawn_values` reads it."""
    defs = {name: _drawn_inside(of) for name, of in whole.get("$defs", {}).items()}
    return {**_drawn_inside(whole), "$defs": defs}


def _drawn_inside(node: Schema) -> Schema:
    """The values in a group or a list may be drawn, the group or list itself stays one."""
    inside = dict(node)
    if "properties" in node:
        inside["properties"] = {name: _drawn(inner) for name, inner in node["properties"].items()}
    if "items" in node:
        inside["items"] = _drawn(node["items"])
    return inside


def _drawn(node: Schema) -> Schema:
    kept = {key: node[key] for key in ("title", "description", "default") if key in node}
    bare = {key: value for key, value in node.items() if key not in kept}
    values = [_drawn_inside(branch) for branch in bare.get("anyOf", [bare])]
    if any(branch.get("type") in ("number", "integer") for branch in values):
        values.append(_range(next(branch for branch in values if branch.get("type") in ("number", "integer"))))
    choice = {
        "type": "object",
        "properties": {_ONE_OF: {"type": "array", "items": {"anyOf": values}, "minItems": 1}},
        "required": [_ONE_OF],
        "additionalProperties": False,
    }
    return kept | {"anyOf": [*values, choice]}


def _range(number: Schema) -> Schema:
    """[LOW, HIGH], both of which the number may be."""
    return {"type": "array", "prefixItems": [number, number], "minItems": 2, "maxItems": 2}


def closed(node: Any) -> Any:  # noqa: ANN401 - any part of a schema
    """The same with names refused that fit no pattern where names have to fit one, as the readers do."""
    if isinstance(node, Mapping):
        inside = {key: closed(inner) for key, inner in node.items()}
        return {"additionalProperties": False, **inside} if "patternProperties" in node else inside
    return [closed(inner) for inner in node] if isinstance(node, list) else node


def without_unused(schema: Schema) -> Schema:
    """The same without definitions that nothing refers to."""
    defs = schema.get("$defs", {})
    kept: set[str] = set()
    to_see = set(_references({key: value for key, value in schema.items() if key != "$defs"}))
    while to_see:
        name = to_see.pop()
        kept.add(name)
        to_see |= set(_references(defs[name])) - kept
    slim = {key: value for key, value in schema.items() if key != "$defs"}
    return slim | ({"$defs": {name: of for name, of in defs.items() if name in kept}} if kept else {})


def _references(node: object) -> Iterator[str]:
    if isinstance(node, Mapping):
        if isinstance(node.get("$ref"), str):
            yield node["$ref"].rpartition("/")[2]
        for inner in node.values():
            yield from _references(inner)
    elif isinstance(node, list):
        for inner in node:
            yield from _references(inner)


def json_schema(kind: str) -> str:
    """The JSON Schema of a kind of file as text; raises KeyError where there is no such kind."""
    reader = KINDS[kind].reader
    made = _MADE[kind]() if reader is None else reader().model_json_schema()
    return json.dumps(closed(made), indent=2) + "\n"


def schema_text(kind: FileKind) -> str:
    """The schema as it ships, or made now where there is none yet: in a clone."""
    return kind.text() if kind.file.is_file() else json_schema(kind.name)


def placed(kind: FileKind) -> Path:
    """Where the schema lies; it is written there if it is not yet. Raises OSError where that cannot be done."""
    if not kind.file.is_file():
        _write(kind, kind.file)
    return kind.file


def write_all(package: Path = PACKAGE) -> None:
    """Write every schema to its place in our package, or in a copy of it; raises OSError where that cannot be done."""
    for kind in KINDS.values():
        _write(kind, package / kind.file.relative_to(PACKAGE))


def _write(kind: FileKind, file: Path) -> None:
    file.parent.mkdir(exist_ok=True)
    file.write_text(json_schema(kind.name), encoding="utf-8")


def _as_it_is(schema: type[BaseModel]) -> Callable[[], Schema]:
    return schema.model_json_schema


def _controllers() -> Schema:
    """The two rooms of a configuration: groups that stand in both are cut in two."""
    whole = ControllerConfig.model_json_schema()
    groups = whole["$defs"]
    rooms: tuple[Schema, Schema] = ({}, {})
    # Groups of features have the schemas of their packages, whichever are installed.
    del whole["properties"]["features"], groups["FeatureGroup"]
    features = {name: {"type": "object"} for name in known_packages()["features"]}
    for name, field in whole["properties"].items():
        reference = field.get("$ref") or next((one["$ref"] for one in field.get("allOf", ()) if "$ref" in one), None)
        if reference is None:
            rooms[not is_for_users(name)][name] = field
            continue
        group = groups[reference.rsplit("/", 1)[-1]]
        for room, wanted in zip(rooms, (True, False), strict=True):
            keys = {key: of for key, of in group["properties"].items() if is_for_users(f"{name}.{key}") == wanted}
            if keys:
                room[name] = {**group, "properties": keys}
    expert = {
        "type": "object",
        "title": "For experts",
        "additionalProperties": False,
        "properties": rooms[1] | features,
    }
    return {**whole, "properties": rooms[0] | {EXPERT: expert}}


def _models() -> Schema:
    functions = (function_structure.schema() for function_structure in function_structures().values())
    files: list[Any] = [*(structure.file for structure in STRUCTURES.values()), *functions]
    return {"title": "Velocity model", **TypeAdapter(reduce(or_, files)).json_schema()}


def _trajectories() -> Schema:
    return {"title": "Trajectory", **TypeAdapter(SegmentFile | WaypointFile).json_schema()}


def _worlds() -> Schema:
    """What differs in sight from the shipped one is said; what movers do may be drawn, the rest is said."""
    whole = only_what_differs(World.model_json_schema(), {"sight": world_settings().sight.model_dump()})
    defs = whole["$defs"]
    return {**whole, "$defs": {**defs, "Mover": with_draws({**defs["Mover"], "$defs": {}})}}


def _with_factors(schema: type[BaseModel]) -> Callable[[], Schema]:
    """A campaign's factors are read one by one, each by what it is."""

    def made() -> Schema:
        whole = schema.model_json_schema()
        values = TypeAdapter(reduce(or_, (*DRAWS.values(), bool, int, float, str))).json_schema()
        whole["$defs"] = whole.get("$defs", {}) | values.pop("$defs")
        factors = whole["properties"]["factors"]
        names = "|".join((*FACTORS_OF_A_CASE, CONDITION))
        factors["propertyNames"] = {"pattern": f"^({names}|({'|'.join(GROUPS)})\\..+)$"}
        factors["additionalProperties"] = values
        return whole

    return made


_MADE: dict[str, Callable[[], Schema]] = {
    "controller": _controllers,
    "monitor": _as_it_is(Rules),
    "trajectory": _trajectories,
    "model": _models,
    "stated-robot": _as_it_is(MakersRobot),
    "mapping": _as_it_is(LogMapping),
    "vehicle": _as_it_is(Vehicle),
    "drive": _as_it_is(DriveConstants),
    "turn-costs": _as_it_is(TurnCosts),
    "robot": lambda: only_what_differs(SimulatedRobot.model_json_schema(), digital_twin()),
    "surface": _as_it_is(Surface),
    "sensors": lambda: only_what_differs(SensorSet.model_json_schema(), load_sensor_set(DEFAULT).model_dump()),
    "scenario": lambda: with_draws(Scenario.model_json_schema()),
    "world": _worlds,
    "experiment": _as_it_is(ExperimentFile),
    "campaign": _with_factors(Campaign),
    "proof": _with_factors(Proof),
    "tune": _with_factors(TunePlan),
    "conditions": _as_it_is(Conditions),
}

if __name__ == "__main__":
    write_all(*map(Path, sys.argv[1:]))
