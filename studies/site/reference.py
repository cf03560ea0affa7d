"""Pages of the reference, which are made from the code when the site is built."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

import diffdrive_mpc as package
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.schemas.generate import schema_text
from diffdrive_mpc.bench.command_line.file_kinds import KINDS
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.file_kind import FileKind
from studies.documents.declared_tables import configuration_tables, node_table

# The kinds of YAML files as a page, from their JSON Schemas.


_HEAD = """# What may stand in a file for a model, a path, a log, a floor, a campaign?

The keys of this page, which is made from the JSON Schemas that ship. `diffdrive-mpc schema KIND --out FILE` writes one,
so that an editor completes and checks such a file while you write ([how](../install.md#editors)). A key with a point
lies in a group. The controller's configuration has [a page of its own](configuration.md).
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
    return "\n\n".join([title, facts, *(_table(one, schema) for one in _alternatives(schema, schema))])


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
    found = _alternatives(field, schema)
    return found[0] if len(found) == 1 and "properties" in found[0] else None


def _alternatives(field: Schema, schema: Schema) -> list[Schema]:
    """What a field may be, references followed, nothing left out but null."""
    if "$ref" in field:
        return _alternatives(schema["$defs"][field["$ref"].rpartition("/")[2]], schema)
    choices = field.get("anyOf", field.get("oneOf", []))
    if choices:
        return [one for part in choices for one in _alternatives(part, schema)]
    return [] if field.get("type") == "null" else [field]


def _allowed(field: Schema, schema: Schema) -> str:
    return " or ".join(dict.fromkeys(filter(None, (_text_of(one) for one in _alternatives(field, schema)))))


def _text_of(one: Schema) -> str:
    values = one.get("enum", [one["const"]] if "const" in one else [])
    bounds = ", ".join(f"{sign} {one[name]:g}" for name, sign in _BOUNDS.items() if name in one)
    return ", ".join(map(str, values)) or bounds or {"array": "list", "object": "group"}.get(one.get("type", ""), "")


def _default(field: Schema) -> str:
    default = field.get("default")
    return "" if default in (None, {}, [], "") else f"`{json.dumps(default)}`"


def _meaning(field: Schema, schema: Schema) -> str:
    inner = (str(one.get("description", "")) for one in _alternatives(field, schema))
    return field.get("description") or next(filter(None, inner), "")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("[", "\\[").replace("*", "\\*")


# The command line as a page, from the commands themselves.


_COMMAND_LINE_HEAD = """# Which commands and options are there?

`diffdrive-mpc COMMAND --help` says the same as this page, which is made from the commands. Bad input ends in one line
on stderr and exit code 2; see [what can go wrong](../failure.md#on-the-command-line).
"""
_EXAMPLE = re.compile(r"^Examples?:\s*", re.MULTILINE)


def command_line_page() -> str:
    """Every command with its arguments, options, defaults and example, as Markdown."""
    commands = list(_commands("diffdrive-mpc", typer.main.get_command(app)))
    rows = [f"| [`{_short(name)}`](#{_anchor(name)}) | {_first_line(command)} |" for name, command in commands]
    parts = [_COMMAND_LINE_HEAD, "\n".join(["| command | what it does |", "| --- | --- |", *rows])]
    return "\n\n".join([*parts, *(_command_line_section(name, command) for name, command in commands)]) + "\n"


def _commands(prefix: str, command: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - typer has no common type
    """Commands that do something, by their whole name, those of groups included."""
    for name, child in sorted(command.commands.items()):
        if hasattr(child, "commands"):
            yield from _commands(f"{prefix} {name}", child)
        else:
            yield f"{prefix} {name}", child


def _command_line_section(name: str, command: Any) -> str:  # noqa: ANN401
    arguments = [one for one in command.params if not one.opts[0].startswith("-")]
    options = [one for one in command.params if one.opts[0].startswith("-") and one.name != "help"]
    usage = " ".join([name, *map(_metavar, arguments), *(["[OPTIONS]"] if options else [])])
    parts = [f"## {_short(name)} {{ #{_anchor(name)} }}", f"```text\n{usage}\n```"]
    parts.append(_text(command.help))
    rows = [f"| `{_metavar(one)}` | | {_cell(one.help)} |" for one in arguments]
    rows += [f"| {_names(one)} | {_default(one)} | {_cell(one.help)} |" for one in options]
    if rows:
        parts.append("\n".join(["| argument or option | default | meaning |", "| --- | --- | --- |", *rows]))
    if command.epilog:
        example = _EXAMPLE.sub("", command.epilog).strip()
        parts.append(f"Example:\n\n```text\n{example}\n```")
    return "\n\n".join(filter(None, parts))


def _names(option: Any) -> str:  # noqa: ANN401
    names = ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])
    return names if option.is_flag or not option.metavar else f"{names} `{option.metavar}`"


def _metavar(argument: Any) -> str:  # noqa: ANN401
    name = argument.metavar or argument.name.upper()
    return name if argument.required else f"[{name}]"


def _command_line_default(option: Any) -> str:  # noqa: ANN401
    if isinstance(option.show_default, str):
        return _command_line_cell(option.show_default)
    plain = isinstance(option.default, str | int | float) and option.default is not False
    return f"`{option.default}`" if option.show_default and plain else ""


def _command_line_cell(text: str | None) -> str:
    return " ".join(_text(text).split()).replace("|", "\\|")


def _text(text: str | None) -> str:
    """Help as Markdown shows it: no emphasis by asterisks and underscores that stand in it."""
    return re.sub(r"([*_<>\[\]])", r"\\\1", text or "")


def _first_line(command: Any) -> str:  # noqa: ANN401
    return _command_line_cell((command.help or "").partition("\n\n")[0])


def _anchor(name: str) -> str:
    return _short(name).replace(" ", "-")


def _short(name: str) -> str:
    return name.removeprefix("diffdrive-mpc ")


_NAMES = Path(__file__).with_name("public_names.yaml")
_PACKAGE = package.__name__

_API = """# Which classes and functions are public?

Those of this page: they keep their names and meanings from one release to the next, or the [changelog](../changelog.md)
says so. Units are SI: metres, radians, seconds; angles count counter-clockwise; arrays are NumPy's, with their shapes
in brackets. Each group begins with the lines that import it.
"""
_CONFIGURATION = """# What may stand in a configuration file?

These keys, in one YAML file; what is left out has its default. A key with a point lies in a group:
`weights.across: 300.0` is written as `weights: {across: 300.0}`, and `--set weights.across=300` replaces it for one
command. `diffdrive-mpc config check FILE` checks a file, `diffdrive-mpc config show ssm` prints a shipped one with all
its values, and `diffdrive-mpc schema controller` has the JSON Schema with which an editor completes and checks while
you type ([how](../install.md#editors)).
Under ROS the same keys are the node's parameters. What a symptom asks for is in [tuning](../tuning.md).
"""
_ROS = """# Which topics, services and parameters does the ROS 2 node have?

The ones of this page. How to bring the node onto a robot is in [the guide](../robot.md); the parameters of the
controller, which are also the node's, are in [the configuration](configuration.md).
"""


def reference_pages(documents: Mapping[str, str]) -> dict[str, str]:
    """The pages as Markdown by place on the site; `documents` are those of the repository, text by path."""
    pages: dict[str, Callable[[], str]] = {
        "api": api_page,
        "command-line": command_line_page,
        "configuration": lambda: f"{_CONFIGURATION}\n{_one_up(configuration_tables())}\n",
        "files": file_formats_page,
        "ros": lambda: ros_page(documents["docs/robot.md"]),
    }
    return {f"reference/{name}.md": page() for name, page in pages.items()}


def api_page() -> str:
    """The public names by what they are for, as directives of mkdocstrings."""
    parts = [_API]
    for title, names in public_names().items():
        imports = "\n".join(_imports(names))
        parts += [f"## {title}\n", f"```python\n{imports}\n```\n", *(f"::: {_PACKAGE}.{name}\n" for name in names)]
    return "\n".join(parts)


def _imports(names: list[str]) -> list[str]:
    """Lines that import the names, those of the package itself first."""
    homes: dict[str, list[str]] = {}
    for module, name in (name.rsplit(".", 1) for name in names):
        homes.setdefault("" if name in package.__all__ else f".{module}", []).append(name)
    return [f"from {_PACKAGE}{home} import {', '.join(homes[home])}" for home in sorted(homes)]


def public_names() -> dict[str, list[str]]:
    """Dotted names below the package by title of their group."""
    groups: dict[str, list[str]] = read_yaml(_NAMES)
    return groups


def ros_page(guide: str) -> str:
    """Topics, services, frames and states, as the guide of the node has them, and its own parameters."""
    shown = [section(guide, title) for title in ("Topics, services, frames", "States", "The safety ladder")]
    # They have links of the guide, which lies one folder further up.
    return "\n".join([_ROS, *(part.replace("](", "](../") for part in [*shown, _one_up(node_table())]), ""])


def section(page: str, title: str) -> str:
    """The section of that title; raises ConfigError if the page has none."""
    found = re.search(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    if not found:
        raise ConfigError(f"no section '{title}' in the page that the site takes it from; name it so again")
    return found[0]


def _one_up(tables: str) -> str:
    return re.sub(r"^###", "##", tables, flags=re.MULTILINE)
