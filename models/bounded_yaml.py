"""YAML text to plain values, with bounds: what is deep, huge or refers to itself is refused before it is built."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

try:
    from yaml import CSafeLoader as SafeLoader  # ten times as quick
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]

DEEPEST = 60
"""Levels of lists and groups; the parser below would run out of stack at some thousands."""
MOST_VALUES = 2_000_000
"""Keys and values, those that aliases repeat counted each time: a trajectory of 400,000 timed poses."""

_UNFIT = (LookupError, TypeError, AttributeError, ArithmeticError, ValueError)
"""What PyYAML raises, beside its own errors, for a tag whose value does not fit it."""


class _UniqueKeyLoader(SafeLoader):
    """Safe YAML loader that refuses a key given twice: the second would silently win.

    1e-3 is a number, as in YAML 1.2 and for editors; YAML 1.1 takes it for a word.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise yaml.MarkedYAMLError(problem="a key must be a word or a number", problem_mark=key_node.start_mark)
            if key in seen:
                raise yaml.MarkedYAMLError(problem=f"key '{key}' is given twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


_UniqueKeyLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def parse_yaml(text: str) -> Any:  # noqa: ANN401 - the schema that checks it gives it a type
    """The values in `text`; nothing in it is executed.

    Raises
    ------
    yaml.YAMLError
        If it is no YAML, has a key twice, is deeper than `DEEPEST`, holds more than `MOST_VALUES`, refers to itself, or
        a value does not fit its tag.
    """
    _check_bounds(text)
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)
    except _UNFIT as error:  # such as the date 2020-13-40, or `!!bool z`
        raise yaml.YAMLError(f"a value does not fit its type: {error or type(error).__name__}") from error


class _Part:
    """A list or a group that is being read: how much is in it, how deep it goes, and what it is called."""

    def __init__(self, anchor: str | None) -> None:
        self.anchor = anchor
        self.values, self.depth = 1, 1

    def take(self, values: int, depth: int) -> None:
        """Take in what stands inside."""
        self.values += values
        self.depth = max(self.depth, depth + 1)


def _check_bounds(text: str) -> None:
    """Go through the events of the parser, which builds nothing and does not recurse."""
    whole = _Part(None)
    open_parts, known = [whole], dict[str, _Part]()
    for event in yaml.parse(text, Loader=SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            open_parts.append(_Part(event.anchor))
        elif isinstance(event, yaml.CollectionEndEvent):
            closed = open_parts.pop()
            if closed.anchor:
                known[closed.anchor] = closed
            open_parts[-1].take(closed.values, closed.depth)
        elif isinstance(event, yaml.AliasEvent):
            if any(part.anchor == event.anchor for part in open_parts):
                raise _refused(f"'*{event.anchor}' refers to what it stands in", event)
            meant = known.get(event.anchor or "")
            open_parts[-1].take(meant.values if meant else 1, meant.depth if meant else 0)
        elif isinstance(event, yaml.ScalarEvent):
            open_parts[-1].take(1, 0)
        if len(open_parts) - 1 + open_parts[-1].depth - 1 > DEEPEST:
            raise _refused(f"more than {DEEPEST} levels of lists and groups", event)
        if open_parts[-1].values > MOST_VALUES:
            raise _refused(f"more than {MOST_VALUES:,} values", event)


def _refused(problem: str, event: yaml.Event) -> yaml.MarkedYAMLError:
    mark: Any = event.start_mark  # of the parser in C or of that in Python; both have lines
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)
