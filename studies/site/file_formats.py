"""The kinds of YAML files as a page, from their JSON Schemas."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from diffdrive_mpc.app.command_line.file_kinds import KINDS
from diffdrive_mpc.app.schemas.generate import schema_text
from diffdrive_mpc.models.file_kind import FileKind

_HEAD = """# What may stand in a file for a model, a path, a log, a floor, a campaign?

The keys of this page, which is made from the JSON Schemas that ship. `diffdrive-mpc schema KIND --out FILE` writes one,
so that an editor completes and checks such a file while you write ([how](../install.md#editors)). A key with a point
lies in a group. The controller's configuration has [a page of its own](../parameters.md).
"""
_COLUMNS = "| key | default | allowed | meaning |\n| --- | --- | --- | --- |"
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
# Groups inside groups that have keys of their own; what lies deeper is told by the schema only.
_DEPTH = 2

Schema = dict[str, Any]


def file_formats_page() -> str:
    """Every kind of file with its keys, as Markdown."""
    return "\n\n".join([_HEAD, *(_section(kind) for name, kind in KINDS.items() if name != "controller")]) + "\n"


def _section(kind: FileKind) -> str:
    schema: Schema = json.loads(schema_text(kind))
    names = ", ".join(f"`{path.stem}`" for path in kind.files)
    facts = f"For `{kind.given}`." + (f" Shipped: {names}." if names else "")
    title = f"## {kind.name}: {kind.what} {{ #{kind.name} }}"
    return "\n\n".join([title, facts, *(_table(choice, schema) for choice in _alternatives(schema, schema))])


def _table(part: Schema, schema: Schema) -> str:
    rows = "\n".join(_rows(part, schema, ""))
    about = _cell(part.get("description", ""))
    return "\n\n".join(filter(None, [about, f"{_COLUMNS}\n{rows}"]))


def _rows(part: Schema, schema: Schema, prefix: str, needed: str = "required") -> Iterator[str]:
    required = part.get("required", [])
    for name, field in part["properties"].items():
        group = _group(field, schema) if prefix.count(".") < _DEPTH else None
        if group is not None:
            # Of a group that may be left out nothing is required but with it.
            inside = needed if name in required else "required in the group"
            yield from _rows(group, schema, f"{prefix}{name}.", inside)
            continue
        default = needed if name in required else _default(field)
        yield f"| `{prefix}{name}` | {default} | {_cell(_allowed(field, schema))} | {_cell(_meaning(field, schema))} |"


def _group(field: Schema, schema: Schema) -> Schema | None:
    """The one group that a field may be, if it may be nothing else."""
    alternatives = _alternatives(field, schema)
    return alternatives[0] if len(alternatives) == 1 and "properties" in alternatives[0] else None


def _alternatives(field: Schema, schema: Schema) -> list[Schema]:
    """What a field may be, references followed, nothing left out but null."""
    if "$ref" in field:
        return _alternatives(schema["$defs"][field["$ref"].rpartition("/")[2]], schema)
    choices = field.get("anyOf", field.get("oneOf", []))
    if choices:
        return [choice for part in choices for choice in _alternatives(part, schema)]
    return [] if field.get("type") == "null" else [field]


def _allowed(field: Schema, schema: Schema) -> str:
    return " or ".join(dict.fromkeys(filter(None, (_text_of(choice) for choice in _alternatives(field, schema)))))


def _text_of(schema: Schema) -> str:
    values = schema.get("enum", [schema["const"]] if "const" in schema else [])
    bounds = ", ".join(f"{sign} {schema[name]:g}" for name, sign in _BOUNDS.items() if name in schema)
    return ", ".join(map(str, values)) or bounds or {"array": "list", "object": "group"}.get(schema.get("type", ""), "")


def _default(field: Schema) -> str:
    default = field.get("default")
    return "" if default in (None, {}, [], "") else f"`{json.dumps(default)}`"


def _meaning(field: Schema, schema: Schema) -> str:
    inner = (str(choice.get("description", "")) for choice in _alternatives(field, schema))
    return field.get("description") or next(filter(None, inner), "")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")
