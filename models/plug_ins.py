"""Entry points through which other packages extend this package.

A distribution registers a plug-in in its `pyproject.toml`:

    [project.entry-points."diffdrive_mpc.peers"]
    mine = "my_package.my_peer:PEER"

`GROUPS` lists the groups. The name of an entry is the name under which users select the plug-in: a command, a
controller feature and its configuration group, a peer, a plant. Listing names imports nothing; a plug-in is imported on
first use.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.errors import MissingPackageError

GROUPS = ("commands", "structures", "features", "node_parts", "plants", "peers", "columns", "parameter_writers")


@cache
def _entries(group: str) -> Mapping[str, EntryPoint]:
    entries = entry_points(group=f"diffdrive_mpc.{group}")
    return {entry.name: entry for entry in sorted(entries, key=lambda entry: entry.name)}


def plug_in_names(group: str) -> tuple[str, ...]:
    """Return the names registered in a group, sorted, without imports."""
    return tuple(_entries(group))


@cache
def plug_in(group: str, name: str) -> Any:  # noqa: ANN401 - each group has its own type
    """Import and return the plug-in `name` of a group.

    Raises
    ------
    MissingPackageError
        If no installed package registers the plug-in; the message names its package, if known.
    ImportError
        If a module that the plug-in needs is missing.
    """
    entry = _entries(group).get(name)
    if entry is None:
        raise MissingPackageError(missing_part(group, name))
    return entry.load()


def plug_ins(group: str) -> tuple[Any, ...]:
    """Import and return all plug-ins of a group, sorted by name; raise ImportError as `plug_in`."""
    return tuple(plug_in(group, name) for name in plug_in_names(group))


@cache
def known_packages() -> Mapping[str, Mapping[str, str]]:
    """Return the package of each plug-in of this project, by group and name."""
    import yaml  # noqa: PLC0415 - only needed if a plug-in is missing

    data = yaml.safe_load(Path(__file__).with_name("known_packages.yaml").read_text(encoding="utf-8"))
    return {
        group: {name: package for package, names in packages.items() for name in names}
        for group, packages in data.items()
    }


def missing_part(group: str, name: str) -> str:
    """Format a message of one line with the package of a missing plug-in and the installation command."""
    kind = group.removesuffix("s").replace("_", " ")
    package = known_packages().get(group, {}).get(name)
    name = name.replace(".", " ") if group == "commands" else name
    if package is None:
        return f"{kind} '{name}': no installed package has it; installed: {', '.join(_entries(group)) or 'none'}"
    extra = package.removeprefix("diffdrive-mpc-")
    return f"{kind} '{name}' is in the package {package}: pip install 'diffdrive-mpc[{extra}]'"


def check_package(group: str, name: object) -> None:
    """Raise MissingPackageError if a known package has the plug-in `name`, which was not found."""
    if str(name) in known_packages().get(group, {}):
        raise MissingPackageError(missing_part(group, str(name)))
