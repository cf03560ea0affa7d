"""Parameter files of ros2_control, Nav2 and robot_localization from what a log tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.identification.stack import Quantities, Quantity
from diffdrive_mpc.models.table import TextTable, plain_line

_DIGITS = 4


@cache
def packages() -> Mapping[str, Any]:
    """Templates by package: nodes, their parameters, and what each is."""
    templates: Mapping[str, Any] = read_yaml(Path(__file__).with_name("stack.yaml"))
    return templates


def chosen_packages(text: str) -> tuple[str, ...]:
    """Names of packages in a list with commas; raises ConfigError for any other word."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    unknown = [name for name in names if name not in packages()]
    if unknown:
        raise ConfigError(f"--for {unknown[0]}: unknown package; give one or more of {','.join(packages())}")
    return names


def package_file(package: str) -> str:
    """Name of the parameter file of a package."""
    return f"{package}.yaml"


def package_text(package: str, quantities: Quantities) -> str:
    """The parameter file of a package: values with interval and reason; what is not known is a comment."""
    lines = [f"# {package}, from a log by `diffdrive-mpc identify --for {package}`. Intervals are of 95 %."]
    for node, parameters in packages()[package].items():
        lines += [f"{node}:", "  ros__parameters:"]
        lines += [f"    {_line(name, content, quantities)}" for name, content in parameters.items()]
    return "\n".join(lines) + "\n"


def _line(name: str, content: object, quantities: Quantities) -> str:
    """One parameter as it stands in the file."""
    if isinstance(content, Mapping):
        if "missing" in content:
            return f"# {name}: not known: {content['missing']}"
        return f"{name}: {_yaml(content['is'])}   # {content['why']}"
    entries = content if isinstance(content, Sequence) and not isinstance(content, str) else [content]
    named = {entry: quantities[entry.removeprefix("-")] for entry in entries if isinstance(entry, str)}
    missing = [f"{entry.removeprefix('-')}: {part.reason}" for entry, part in named.items() if part.value is None]
    if missing:
        return f"# {name}: not known: {plain_line('; '.join(missing))}"
    values = [_signed(entry, named[entry]) if isinstance(entry, str) else entry for entry in entries]
    reasons = "; ".join(dict.fromkeys(interval_words(part) + part.reason for part in named.values()))
    return f"{name}: {_yaml(values[0] if content is entries[0] else values)}   # {plain_line(reasons)}"


def _signed(entry: str, quantity: Quantity) -> float:
    assert quantity.value is not None
    value = float(f"{quantity.value:.{_DIGITS}g}")
    return -value if entry.startswith("-") else value


def _yaml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    # A ROS parameter of type double needs a point, and YAML one before an exponent.
    text = f"{value:.{_DIGITS}g}"
    return text if "." in text else text.replace("e", ".0e") if "e" in text else f"{text}.0"


def interval_words(quantity: Quantity) -> str:
    """The interval with its unit, and a comma and a blank after it."""
    low, high = quantity.interval
    unit = f" {quantity.unit}" if quantity.unit else ""
    return f"[{low:.{_DIGITS}g}, {high:.{_DIGITS}g}]{unit}, " if low < high else f"{quantity.unit}, "


def stack_table(quantities: Quantities) -> TextTable:
    """What the log tells and what not, a row each."""
    rows = [
        (
            name,
            "-" if part.value is None else f"{part.value:.{_DIGITS}g}",
            "not known" if part.value is None else interval_words(part).rstrip(", "),
            part.reason,
        )
        for name, part in quantities.items()
    ]
    note = "Intervals of 95 %. The files say which parameter each is."
    return TextTable(
        "For other packages", ("what", "value", "interval", "reason"), tuple(rows), text_columns=4, note=note
    )
