"""JSON Schemas of files that say less, or other things, than the whole that they stand for."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

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
    said = {key: node[key] for key in ("title", "description") if key in node}
    return resolved | said | {"properties": properties} | ({"required": required} if required else {})


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
    said = {key: node[key] for key in ("title", "description", "default") if key in node}
    bare = {key: value for key, value in node.items() if key not in said}
    values = [_drawn_inside(branch) for branch in bare.get("anyOf", [bare])]
    if any(branch.get("type") in ("number", "integer") for branch in values):
        values.append(_range(next(branch for branch in values if branch.get("type") in ("number", "integer"))))
    choice = {
        "type": "object",
        "properties": {_ONE_OF: {"type": "array", "items": {"anyOf": values}, "minItems": 1}},
        "required": [_ONE_OF],
        "additionalProperties": False,
    }
    return said | {"anyOf": [*values, choice]}


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
