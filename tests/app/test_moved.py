"""Every name of version 0.2.0 still exists or has a row in docs/moved.md."""

import importlib
import json
import re
from fnmatch import fnmatchcase
from pathlib import Path

import typer.main

from diffdrive_mpc import Controller
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.plug_ins import plug_in, plug_in_names
from diffdrive_mpc.mpc.config.described import feature_rows, schema_rows
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.sim import Run
from file_kinds import KINDS

TESTS = Path(__file__).parents[1]
NAMES = json.loads((TESTS / "names_of_0_2_0.json").read_text(encoding="utf-8"))
PAGE = (TESTS.parent / "docs" / "moved.md").read_text(encoding="utf-8")
LISTED = {
    name.removeprefix("diffdrive-mpc ").removeprefix("diffdrive_mpc.").replace(".NAME", ".*")
    for before in re.findall(r"^\| ([^|]*`[^|]*) \|", PAGE, re.MULTILINE)
    for name in re.findall(r"`([^`]+)`", before)
}
"""Names in the first columns of the tables; `*` stands for any text."""


def is_listed(name, min_owner_parts=1):
    """Return True if the page has a row for a name, or for a prefix of it with at least `min_owner_parts` parts."""
    parts = name.split(".")
    prefixes = [name, *(".".join(parts[:count]) for count in range(min_owner_parts, len(parts)))]
    return any(fnmatchcase(prefix, listed) for prefix in prefixes for listed in LISTED)


def commands(group, prefix=""):
    """Yield each command of a group with its options."""
    for name, command in getattr(group, "commands", {}).items():
        yield f"{prefix}{name}", {option for entry in command.params for option in (*entry.opts, *entry.secondary_opts)}
        yield from commands(command, f"{prefix}{name} ")


def python_name_exists(name):
    module, _, attribute = name.rpartition(".")
    try:
        return hasattr(importlib.import_module(f"diffdrive_mpc.{module}".rstrip(".")), attribute)
    except ImportError:
        return False


def missing_command_names():
    present = dict(commands(typer.main.get_command(app)))
    for command, options in NAMES["commands"].items():
        if command in present:
            names = (f"{command} {option}" for option in options if option not in present[command])
            yield from (name for name in names if name not in LISTED)
        elif command not in LISTED:
            yield command


def missing_python_names():
    classes = {"controller": Controller, "run": Run}
    for kind, owner in classes.items():
        annotated = {name for base in owner.__mro__ for name in getattr(base, "__annotations__", {})}
        names = (
            f"{owner.__name__}.{name}" for name in NAMES[kind] if name not in annotated and not hasattr(owner, name)
        )
        yield from (name for name in names if name not in LISTED)
    yield from (name for name in NAMES["python"] if not python_name_exists(name) and not is_listed(name, 2))


def test_each_name_of_0_2_0_exists_or_is_listed():
    keys = [key for key in NAMES["keys"] if not (is_listed(key) or is_listed(key.removeprefix("expert.")))]
    missing = {
        "commands and options": [*missing_command_names()],
        "keys of a configuration": {*keys} - {row.key for row in (*schema_rows(), *feature_rows())},
        "node parameters": {*NAMES["node"]} - {*NodeSettings.model_fields} - LISTED,
        "Python": [*missing_python_names()],
        "kinds of files": {*NAMES["file_kinds"]} - {*KINDS} - LISTED,
    }
    assert {kind: names for kind, names in missing.items() if names} == {}


def test_listed_parameters_of_node_parts_exist():
    rows = re.findall(r"`parts\.(\w+)\.(\w+)`", PAGE.partition("## Parameters of the node")[2].partition("## Files")[0])
    schemas = {name: plug_in("node_parts", name).schema for name in plug_in_names("node_parts")}
    assert rows and all(field in schemas[part].model_fields for part, field in rows)
