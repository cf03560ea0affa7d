"""Reference pages of the site, generated from the code."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import diffdrive_mpc as package
from diffdrive_mpc.app.schemas import json_schema
from diffdrive_mpc.bench.experiment_file import ExperimentFile
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.stated_robot import ManufacturerRobot
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot
from diffdrive_mpc.sim.plants.surface import Surface
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet
from studies.site.command_line import command_line_page

Schema = dict[str, Any]

_HEAD = """# Which keys does a file for a model, a path, a log or a surface have?

This page lists the keys of each kind of file, from the schemas of its readers. Models and trajectories have a JSON
Schema, `diffdrive-mpc config schema KIND --json`, with which an editor completes and checks such a file
([setup](../install.md#editors)). A key with a dot belongs to a group. The controller's configuration has
[a separate page](../parameters.md). A scenario may draw a value: `[LOW, HIGH]` or `{one_of: [...]}`. A robot or a
sensor set may omit every key: the value of the shipped `default` then applies.
"""
_COLUMNS = "| key | default | allowed | meaning |\n| --- | --- | --- | --- |"
_BOUNDS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
# Maximum depth of groups whose keys are listed; keys of deeper groups are only in the schema.
_MAX_DEPTH = 2
_FORMATS: dict[str, tuple[str, str, Callable[[], Schema]]] = {
    "trajectory": ("path to follow", "--trajectory", lambda: json.loads(json_schema("trajectory"))),
    "model": ("velocity model", "--model", lambda: json.loads(json_schema("model"))),
    "mapping": ("columns or topics of a log", "--mapping", LogMapping.model_json_schema),
    "stated-robot": ("data sheet of a robot", "identify --robot", ManufacturerRobot.model_json_schema),
    "robot": ("simulated robot", "--plant mujoco:FILE", SimulatedRobot.model_json_schema),
    "surface": ("driving surface", "--surface", Surface.model_json_schema),
    "sensors": ("sensor set", "--sensors", SensorSet.model_json_schema),
    "scenario": ("events and faults of a drive", "--scenario", Scenario.model_json_schema),
    "experiment": ("varied values, parts and tables of a bench", "bench --spec", ExperimentFile.model_json_schema),
}
"""Title, command-line option and function that reads the schema, by kind of file."""


def file_formats_page() -> str:
    """Describe the keys of each kind of file as Markdown."""
    return "\n\n".join([_HEAD, *map(_section, _FORMATS)]) + "\n"


def _section(kind: str) -> str:
    title, option, read_schema = _FORMATS[kind]
    schema = read_schema()
    parts = [f"## {kind}: {title} {{ #{kind} }}", f"For `{option}`."]
    return "\n\n".join([*parts, *(_table(choice, schema) for choice in _alternatives(schema, schema))])


def _table(part: Schema, schema: Schema) -> str:
    rows = "\n".join(_rows(part, schema, ""))
    title = _cell(part.get("description", ""))
    return "\n\n".join(filter(None, [title, f"{_COLUMNS}\n{rows}"]))


def _rows(part: Schema, schema: Schema, prefix: str, requirement: str = "required") -> Iterator[str]:
    required = part.get("required", [])
    for name, field in part["properties"].items():
        group = _group(field, schema) if prefix.count(".") < _MAX_DEPTH else None
        if group is not None:
            # The keys of an optional group are required only if the group is present.
            group_requirement = requirement if name in required else "required in the group"
            yield from _rows(group, schema, f"{prefix}{name}.", group_requirement)
            continue
        default = requirement if name in required else _default(field)
        yield f"| `{prefix}{name}` | {default} | {_cell(_values(field, schema))} | {_cell(_meaning(field, schema))} |"


def _group(field: Schema, schema: Schema) -> Schema | None:
    """Return the schema of a group if a field accepts only this group; otherwise None."""
    alternatives = _alternatives(field, schema)
    return alternatives[0] if len(alternatives) == 1 and "properties" in alternatives[0] else None


def _alternatives(field: Schema, schema: Schema) -> list[Schema]:
    """Return the schemas of the values that a field accepts, except null; references are resolved."""
    if "$ref" in field:
        return _alternatives(schema["$defs"][field["$ref"].rpartition("/")[2]], schema)
    choices = field.get("anyOf", field.get("oneOf", []))
    if choices:
        return [choice for part in choices for choice in _alternatives(part, schema)]
    return [] if field.get("type") == "null" else [field]


def _values(field: Schema, schema: Schema) -> str:
    return " or ".join(dict.fromkeys(filter(None, map(_allowed_values, _alternatives(field, schema)))))


def _allowed_values(schema: Schema) -> str:
    values = schema.get("enum", [schema["const"]] if "const" in schema else [])
    bounds = ", ".join(f"{sign} {schema[name]:g}" for name, sign in _BOUNDS.items() if name in schema)
    return ", ".join(map(str, values)) or bounds or {"array": "list", "object": "group"}.get(schema.get("type", ""), "")


def _default(field: Schema) -> str:
    default = field.get("default")
    return "" if default in (None, {}, [], "") else f"`{json.dumps(default)}`"


def _meaning(field: Schema, schema: Schema) -> str:
    descriptions = (str(choice.get("description", "")) for choice in _alternatives(field, schema))
    return field.get("description") or next(filter(None, descriptions), "")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")


_NAMES = Path(__file__).with_name("public_names.yaml")
_PACKAGE = package.__name__

_API = """# Which classes and functions are public?

The classes and functions on this page are public: the [changelog](../changelog.md) lists every change of their names or
meanings. Units are SI: metres, radians, seconds; angles count counter-clockwise; arrays are NumPy's, with their shapes
in brackets. Each group starts with its import statements.
"""
_ROS = """# Which topics, services and states does the ROS 2 node have?

This page lists them. See [the guide](../robot.md) for the setup of the node on a robot,
[safety](../safety.md#what-can-go-wrong) for its reactions to failures, and [its parameters](../parameters.md).
"""


def reference_pages(documents: Mapping[str, str]) -> dict[str, str]:
    """Build the reference pages as Markdown by path on the site; `documents` contains files of the repository."""
    pages: dict[str, Callable[[], str]] = {
        "api": api_page,
        "command-line": command_line_page,
        "files": file_formats_page,
        "ros": lambda: ros_page(documents["docs/robot.md"]),
    }
    return {f"reference/{name}.md": page() for name, page in pages.items()}


def api_page() -> str:
    """Build the page of the public names by purpose, with directives of mkdocstrings."""
    parts = [_API]
    for title, names in public_names().items():
        imports = "\n".join(_imports(names))
        parts += [f"## {title}\n", f"```python\n{imports}\n```\n", *(f"::: {_PACKAGE}.{name}\n" for name in names)]
    return "\n".join(parts)


def _imports(names: list[str]) -> list[str]:
    """Build the statements that import the names; names of the top-level package are first."""
    modules: dict[str, list[str]] = {}
    for module, name in (name.rsplit(".", 1) for name in names):
        modules.setdefault("" if name in package.__all__ else f".{module}", []).append(name)
    return [f"from {_PACKAGE}{module} import {', '.join(modules[module])}" for module in sorted(modules)]


def public_names() -> dict[str, list[str]]:
    """Load the public names, relative to the package, by title of their group."""
    groups: dict[str, list[str]] = read_yaml(_NAMES)
    return groups


def ros_page(guide: str) -> str:
    """Build the page on topics, services, frames and states from the guide on the node."""
    sections = [section(guide, title) for title in ("Topics, services, frames", "States")]
    # Links of the guide are relative to its folder, which is one level up.
    return "\n".join([_ROS, *(part.replace("](#", "](robot.md#").replace("](", "](../") for part in sections), ""])


def section(page: str, title: str) -> str:
    """Extract a section by its title; raise ConfigError if the page does not contain the section."""
    match = re.search(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    if not match:
        raise ConfigError(f"no section '{title}' in the source page; restore its title")
    return match[0]
