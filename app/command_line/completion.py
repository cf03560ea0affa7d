"""What a shell completes after an option: names of shipped files and keys of the configuration.

A key press waits for it: files are listed and one JSON file is read, nothing else is imported.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffdrive_mpc.models.file_kind import FileKind

Offered = Iterator[tuple[str, str]]
"""Words, each with what it means, or nothing."""
Completer = Callable[[str], list[tuple[str, str]]]
_DESCRIPTION = re.compile(r"^description: (.*)$", re.MULTILINE)


def choices(what: str, *, several: bool = False) -> Completer:
    """What completes a word of the kind `what`; with `several` the last one of a list with commas."""

    def complete(incomplete: str) -> list[tuple[str, str]]:
        before, comma, last = incomplete.rpartition(",") if several else ("", "", incomplete)
        taken = set(before.split(","))
        try:
            offered = [
                (word, description)
                for word, description in _OFFERS[what]()
                if word.startswith(last) and word not in taken
            ]
        except OSError:  # in a clone without schemas
            return []
        return [(f"{before}{comma}{word}", description) for word, description in offered]

    return complete


def offers(what: str) -> bool:
    """Whether there is something to complete words of the kind `what` with."""
    return what in _OFFERS


def _shipped(kind: str) -> Callable[[], Offered]:
    def offered() -> Offered:
        for name, text in _kinds_of_files()[kind].texts.items():
            match = _DESCRIPTION.search(text)
            yield name, match[1] if match else ""

    return offered


def _plants() -> Offered:
    yield "mujoco", "the physics"
    for name, description in _shipped("robot")():
        yield f"mujoco:{name}", description
    for name, _ in _shipped("model")():
        yield f"model:{name}", "a velocity model"


def _controllers() -> Offered:
    from diffdrive_mpc.bench.peers import PEERS  # noqa: PLC0415 - the node's command loads no bench

    yield "mpc", "the predictive controller"
    for name in PEERS:
        yield name, "a peer"


def _timings() -> Offered:
    from diffdrive_mpc.bench.case import AS_FILED  # noqa: PLC0415 - the node's command loads no bench

    timing = _schema("trajectory")["$defs"]["SegmentFile"]["properties"]["timing"]
    yield from ((word, "") for word in timing["enum"])
    yield AS_FILED, "what the file says"


def _settings() -> Offered:
    """KEY=VALUE with the default, or with each of the words that a key takes."""
    schema = _schema("controller")
    yield from _keys(schema, schema["$defs"], "")


def _keys(group: Mapping[str, Any], defs: Mapping[str, Any], prefix: str) -> Offered:
    for name, field in group["properties"].items():
        below = defs[field["$ref"].rpartition("/")[2]] if "$ref" in field else field
        if "properties" in below:
            yield from _keys(below, defs, f"{prefix}{name}.")
        elif field.get("type") != "array":
            for value in field.get("enum", [field.get("default")]):
                yield f"{prefix}{name}={_written(value)}", field.get("description", "")


def _written(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _schema(kind: str) -> dict[str, Any]:
    from diffdrive_mpc.app.command_line.file_kinds import SCHEMAS  # noqa: PLC0415 - most commands complete nothing

    schema: dict[str, Any] = json.loads(SCHEMAS[kind].read_text(encoding="utf-8"))
    return schema


def _kinds_of_files() -> Mapping[str, FileKind]:
    from diffdrive_mpc.app.command_line.file_kinds import KINDS  # noqa: PLC0415 - who completes nothing needs none

    return KINDS


_OFFERS: dict[str, Callable[[], Offered]] = {
    "config": _shipped("controller"),
    "controller": _controllers,
    "drive": _shipped("drive"),
    "mapping": _shipped("mapping"),
    "model": _shipped("model"),
    "plant": _plants,
    "scenario": _shipped("scenario"),
    "sensors": _shipped("sensors"),
    "setting": _settings,
    "stated-robot": _shipped("stated-robot"),
    "surface": _shipped("surface"),
    "timing": _timings,
    "trajectory": _shipped("trajectory"),
    "turn-costs": _shipped("turn-costs"),
    "vehicle": _shipped("vehicle"),
    "world": _shipped("world"),
}
