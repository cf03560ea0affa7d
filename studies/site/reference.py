"""Pages of the reference, which are made from the code when the site is built."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import diffdrive_mpc as package
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from studies.site.command_line import command_line_page
from studies.site.file_formats import file_formats_page

_NAMES = Path(__file__).with_name("public_names.yaml")
_PACKAGE = package.__name__

_API = """# Which classes and functions are public?

Those of this page: they keep their names and meanings from one release to the next, or the [changelog](../changelog.md)
says so. Units are SI: metres, radians, seconds; angles count counter-clockwise; arrays are NumPy's, with their shapes
in brackets. Each group begins with the lines that import it.
"""
_ROS = """# Which topics, services and states does the ROS 2 node have?

The ones of this page. How to bring the node onto a robot is in [the guide](../robot.md), what it does when something
fails in [safety](../safety.md#what-can-go-wrong); its parameters are in [tables of their own](../parameters.md).
"""


def reference_pages(documents: Mapping[str, str]) -> dict[str, str]:
    """The pages as Markdown by place on the site; `documents` are those of the repository, text by path."""
    pages: dict[str, Callable[[], str]] = {
        "api": api_page,
        "command-line": command_line_page,
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
    """Topics, services, frames and states, as the guide of the node has them."""
    shown = [section(guide, title) for title in ("Topics, services, frames", "States")]
    # They have links of the guide, which lies one folder further up.
    return "\n".join([_ROS, *(part.replace("](#", "](robot.md#").replace("](", "](../") for part in shown), ""])


def section(page: str, title: str) -> str:
    """The section of that title; raises ConfigError if the page has none."""
    match = re.search(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    if not match:
        raise ConfigError(f"no section '{title}' in the page that the site takes it from; name it so again")
    return match[0]
