"""Parameter files of ros2_control, Nav2 and robot_localization, written from the quantities of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc_extras.stack.estimate import DIGITS, Quantities, Quantity, interval_text


@cache
def packages() -> Mapping[str, Any]:
    """Return the templates by package: nodes, their parameters, and the source of each value."""
    templates: Mapping[str, Any] = read_yaml(Path(__file__).with_name("parameter_files.yaml"))
    return templates


def package_text(package: str, quantities: Quantities) -> str:
    """Return the parameter file of a package: values with interval and reason; missing values as comments."""
    lines = [f"# {package}, from a log by `diffdrive-mpc identify --for {package}`. Intervals: 95 %."]
    for node, parameters in packages()[package].items():
        lines += [f"{node}:", "  ros__parameters:"]
        lines += [f"    {_parameter_line(name, content, quantities)}" for name, content in parameters.items()]
    return "\n".join(lines) + "\n"


def _parameter_line(name: str, content: object, quantities: Quantities) -> str:
    """Return the line of one parameter, or a comment if its value is missing."""
    if isinstance(content, Mapping):
        if "missing" in content:
            return f"# {name}: not known: {content['missing']}"
        return f"{name}: {_yaml_text(content['is'])}   # {content['why']}"
    entries = content if isinstance(content, Sequence) and not isinstance(content, str) else [content]
    by_entry = {entry: quantities[entry.removeprefix("-")] for entry in entries if isinstance(entry, str)}
    missing = [f"{entry.removeprefix('-')}: {part.reason}" for entry, part in by_entry.items() if part.value is None]
    if missing:
        return f"# {name}: not known: {plain_line('; '.join(missing))}"
    values = [_signed_value(entry, by_entry[entry]) if isinstance(entry, str) else entry for entry in entries]
    reasons = "; ".join(dict.fromkeys(interval_text(part) + part.reason for part in by_entry.values()))
    return f"{name}: {_yaml_text(values[0] if content is entries[0] else values)}   # {plain_line(reasons)}"


def _signed_value(entry: str, quantity: Quantity) -> float:
    assert quantity.value is not None
    value = float(f"{quantity.value:.{DIGITS}g}")
    return -value if entry.startswith("-") else value


def _yaml_text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml_text, value))}]"
    # A ROS parameter of type double needs a decimal point, also before an exponent.
    text = f"{value:.{DIGITS}g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"
