"""YAML files that are checked against a typed schema; every mistake is reported in one line with place and remedy."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import SchemaError

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.file_limits import file_limits
from diffdrive_mpc.models.input_file import read_input
from diffdrive_mpc.models.suggestions import similar_name, suggestion, unit_of
from diffdrive_mpc.models.table import plain_line

_KINDS = {
    "structure": "a model; give it as 'model' in a configuration, or by --model if the command has it",
    "variance": "the robot of a log; give it by --plant model:FILE",
    "segments": "a trajectory; give it by --trajectory",
    "waypoints": "a trajectory; give it by --trajectory",
    "columns": "the mapping of a log; give it by --mapping",
    "topics": "the mapping of a log; give it by --mapping",
    "firmware": "a simulated robot; give it by --plant mujoco:FILE",
    "model": "a configuration; --config of simulate, bench and node reads it",
}
"""Kinds of files with their options, by a key that no earlier kind has."""


# Conversion of YAML text to plain values, with bounds: documents that are too deep, too large or recursive are rejected
# before their values are built.


try:
    from yaml import CSafeLoader as SafeLoader  # ten times faster
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]

MAX_DEPTH = file_limits().yaml_depth
"""Maximum nesting depth of lists and groups."""
MAX_VALUES = file_limits().yaml_values
"""Maximum number of keys and values; aliased values are counted at each use."""

_TAG_ERRORS = (LookupError, TypeError, AttributeError, ArithmeticError, ValueError)
"""Exceptions that PyYAML raises, in addition to `YAMLError`, if a value does not match its tag."""


class _UniqueKeyLoader(SafeLoader):
    """Safe YAML loader that rejects duplicate keys, whereas PyYAML silently uses the last value.

    1e-3 is a number, as in YAML 1.2 and in editors; in YAML 1.1 it is a string.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise yaml.MarkedYAMLError(problem="a key must be a word or a number", problem_mark=key_node.start_mark)
            if key in keys:
                raise yaml.MarkedYAMLError(problem=f"key '{key}' is given twice", problem_mark=key_node.start_mark)
            keys.add(key)
        return super().construct_mapping(node, deep=deep)


def _refuse_tag(_loader: _UniqueKeyLoader, node: yaml.Node) -> NoReturn:
    tag = str(node.tag).replace("tag:yaml.org,2002:", "!!")
    problem = f"unknown tag '{tag}': a file may contain only words, numbers, lists and groups; remove the tag"
    raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


_MAX_NUMBER_LENGTH = 1000
"""Maximum number of characters of a number. YAML 1.1 reads 1:1:1 as base 60, in quadratic time."""


def _limit_length(kind: str) -> None:
    """Make the loader reject long numbers of this kind before it converts them."""
    tag = f"tag:yaml.org,2002:{kind}"
    construct = SafeLoader.yaml_constructors[tag]

    def bounded(loader: _UniqueKeyLoader, node: yaml.ScalarNode) -> object:
        if len(node.value) > _MAX_NUMBER_LENGTH:
            problem = f"a number has {len(node.value):,} characters, the limit is {_MAX_NUMBER_LENGTH:,}"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        return construct(loader, node)

    _UniqueKeyLoader.add_constructor(tag, bounded)


_limit_length("int")
_limit_length("float")
# None selects all tags without a constructor.
_UniqueKeyLoader.add_constructor(None, _refuse_tag)
_UniqueKeyLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def parse_yaml(text: str) -> Any:  # noqa: ANN401 - the schema gives it a type
    """Parse `text` as YAML without executing anything in it.

    Raises
    ------
    yaml.YAMLError
        If `text` is invalid YAML, repeats a key, is nested deeper than `MAX_DEPTH`, contains more than `MAX_VALUES`
        values, refers to itself, or contains a value that does not match its tag.
    """
    return pickle.loads(_pickle_yaml(text))


@lru_cache(maxsize=32)
def _pickle_yaml(text: str) -> bytes:
    """Parse a text and pickle its values, so that each caller gets a copy; many drives read the same files."""
    _check_bounds(text)
    try:
        return pickle.dumps(yaml.load(text, Loader=_UniqueKeyLoader))
    except _TAG_ERRORS as error:  # such as the date 2020-13-40, or `!!bool z`
        raise yaml.YAMLError(f"a value does not match its type: {error or type(error).__name__}") from error


def parse_json(text: str | bytes) -> Any:  # noqa: ANN401 - the caller checks its type
    """Parse `text` as JSON; raise ValueError if it is invalid, too large, or too deeply nested for Python."""
    if len(text) > (limit := file_limits().json_bytes):
        raise ValueError(f"the JSON text has {len(text):,} bytes, the limit is {limit:,}")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("lists and groups are nested too deeply") from error


class _OpenCollection:
    """List or group that is being read, with its anchor, number of values and depth."""

    def __init__(self, anchor: str | None) -> None:
        self.anchor = anchor
        self.values, self.depth = 1, 1

    def add(self, values: int, depth: int) -> None:
        """Add the number of values and the depth of a child node."""
        self.values += values
        self.depth = max(self.depth, depth + 1)


def _check_bounds(text: str) -> None:
    """Check the limits on the parser's events; the parser builds no values and does not recurse."""
    document = _OpenCollection(None)
    open_parts, known = [document], dict[str, _OpenCollection]()
    # Count aliased values at each use, because a few lines of nested aliases can represent billions of values.
    for event in yaml.parse(text, Loader=SafeLoader):
        if isinstance(event, yaml.CollectionStartEvent):
            open_parts.append(_OpenCollection(event.anchor))
        elif isinstance(event, yaml.CollectionEndEvent):
            closed = open_parts.pop()
            if closed.anchor:
                known[closed.anchor] = closed
            open_parts[-1].add(closed.values, closed.depth)
        elif isinstance(event, yaml.AliasEvent):
            if any(part.anchor == event.anchor for part in open_parts):
                raise _bounds_error(f"'*{event.anchor}' refers to a value that contains it", event)
            target = known.get(event.anchor or "")
            open_parts[-1].add(target.values if target else 1, target.depth if target else 0)
        elif isinstance(event, yaml.ScalarEvent):
            open_parts[-1].add(1, 0)
        if len(open_parts) - 1 + open_parts[-1].depth - 1 > MAX_DEPTH:
            raise _bounds_error(f"more than {MAX_DEPTH} levels of lists and groups", event)
        if open_parts[-1].values > MAX_VALUES:
            raise _bounds_error(f"more than {MAX_VALUES:,} values", event)


def _bounds_error(problem: str, event: yaml.Event) -> yaml.MarkedYAMLError:
    mark: Any = event.start_mark  # the type depends on the parser (C or Python); both have line numbers
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


_MAX_SHOWN_LENGTH = 100
"""Maximum number of characters of a value or a key in a message."""
_MESSAGES = {
    "invalid_key": "a key is text; write a decimal with a point, as in 1.5",
    "model_type": "expected keys and values, such as KEY: VALUE",
    "list_type": "expected a list; write [A, B], or one item per line after a dash",
    "tuple_type": "expected a list of numbers; write [A, B]",
}
"""Messages by kind of mistake, where those of Pydantic name no remedy."""
_MAX_BITS = 1024
_MAX_MISTAKES = 10
"""Maximum number of mistakes that a message lists."""


class ConfigError(DiffdriveMpcError, ValueError):
    """Error for a parameter or configuration file that cannot be used: one line with place, mistakes and remedies."""


class StrictModel(BaseModel):
    """Base of all schemas: unknown keys are errors, values are immutable, numbers are finite."""

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Return the fields that a file or a caller has set, for a short `repr`."""
        return (pair for pair in super().__repr_args__() if pair[0] in self.model_fields_set)


Schema = TypeVar("Schema", bound=BaseModel)


def read_yaml(path: str | Path) -> Any:  # noqa: ANN401 - the schema gives it a type
    """Parse a YAML file of at most `MAX_VALUES` keys and values without executing anything in it.

    Raises
    ------
    ConfigError
        If the file is missing, unreadable, not a regular file or too large; or if its YAML is invalid, repeats a key,
        is nested too deeply or contains too many values.
    """
    path = Path(path)
    try:
        text = read_input(path, file_limits().yaml_bytes).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        problem = getattr(error, "strerror", None) or "not UTF-8 text; give a YAML file"
        raise ConfigError(f"{path}: cannot be read ({problem})") from error
    try:
        return parse_yaml(text)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = str(error.problem or "not valid YAML")
        problem += "; indent with spaces, not tabs, or quote it" if "cannot start any token" in problem else ""
        problem += "; give a YAML file" if "non-alphabetical" in problem else ""
        raise ConfigError(f"{path}{line}: {problem}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error


def load_checked(schema: type[Schema], path: str | Path) -> Schema:
    """Read the YAML file at `path` and check it against `schema`.

    Raises
    ------
    ConfigError
        If the file does not match; the message is one line that names the file and, for every mistake, the key, the
        error and the correction.
    """
    return check(schema, read_yaml(path), str(path))


def merge_mappings(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge `changes` into a copy of `base`; groups are merged key by key."""
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = merge_mappings(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def check(schema: type[Schema], data: object, where: str, shown: Callable[[str], str] = str) -> Schema:
    """Check `data` against `schema`; in error messages `where` names its source, and `shown` formats a dotted key.

    Raises
    ------
    ConfigError
        As for `load_checked`.
    """
    if not isinstance(data, Mapping):
        kind = "nothing" if data is None else type(data).__name__
        raise ConfigError(f"{where}: expected keys and values, found {kind}; write each value as KEY: VALUE")
    try:
        return schema.model_validate(data)
    except SchemaError as error:
        if "KeyboardInterrupt" in str(error):  # pydantic replaces a Ctrl-C that interrupts the schema build
            raise KeyboardInterrupt from error
        raise
    except ValidationError as error:
        # Limit the number of sentences, because each one requires a search for similar keys.
        details = error.errors()
        unknown = [detail["loc"] for detail in details if detail["type"] == "extra_forbidden"]
        top_level = [key for key, *inner_keys in unknown if not inner_keys]
        if len(top_level) > len(data) / 2 and (described := describe_kind(top_level)):
            raise ConfigError(f"{where}: this is {described}") from error
        sentences = [_sentence(schema, detail, shown) for detail in details[: 3 * _MAX_MISTAKES]]
        more = len(details) - len(sentences)
        for missing in [sentence for sentence in sentences if sentence.endswith(" is missing")]:
            # A misspelt key is reported as unknown, and its correct spelling as missing: keep one of the two sentences.
            if any(f"did you mean {missing.split()[1]}?" in sentence for sentence in sentences):
                sentences.remove(missing)
        raise ConfigError(mistakes(where, sentences, more)) from error


def describe_kind(keys: Collection[object]) -> str | None:
    """Describe the kind of file that has some of `keys`, and how to give it; None if no key identifies the kind."""
    return next((kind for key, kind in _KINDS.items() if key in keys), None)


def mistakes(where: str, sentences: Sequence[str], more: int = 0) -> str:
    """Format all mistakes of `where` in one numbered line, with the number of mistakes that are not listed.

    `more` is the number of mistakes without a sentence.
    """
    different = list(dict.fromkeys(sentences))
    if len(different) + more == 1:
        return f"{where}: {different[0]}"
    listed = [f"({number}) {sentence}" for number, sentence in enumerate(different[:_MAX_MISTAKES], start=1)]
    more += len(different) - len(listed)
    return f"{where}: {len(listed) + more} mistakes: {'; '.join(listed)}{f' (and {more} more)' if more else ''}"


def _sentence(schema: type[BaseModel], error: Any, shown: Callable[[str], str]) -> str:  # noqa: ANN401 - pydantic's
    """Format one of pydantic's errors as a readable sentence."""
    location = [part for part in error["loc"] if not str(part).startswith("function-")]
    place = shown(".".join(plain_line(str(part), _MAX_SHOWN_LENGTH) for part in location))
    kind = error["type"]
    if kind == "extra_forbidden":
        remedy = " Write a space after the colon, as in KEY: VALUE" if ":" in str(location[-1]) else ""
        return f"unknown key '{place}'" + suggestion(schema, location, shown) + remedy
    if kind == "missing":
        return f"key '{place}' is missing"
    message = plain_line(str(error["msg"]).removeprefix("Value error, ").replace(" after validation", ""))
    # One sentence for all items of the list.
    if kind == "tuple_type" and isinstance(location[-1], int) and isinstance(error["input"], (int, float)):
        return f"{shown('.'.join(map(str, location[:-1])))}: expected a list of lists; write [[A, B]]"
    stated_value, hint = error.get("input"), ""
    if kind.startswith(("less_than", "greater_than", "float", "int")) and (unit := unit_of(schema, location)):
        message += f" {unit}" if "_than" in kind else f" in {unit}"
    message = _MESSAGES.get(kind, message)
    if stated_value is None and kind.endswith("_type") and place:
        return f"{place} is empty: " + message.replace("Input should be", "fill in")
    if kind == "literal_error":
        hint = similar_name(str(stated_value), re.findall(r"'([^']*)'", error["ctx"]["expected"]))
    plain = isinstance(stated_value, (int, float, str, bool, type(None)))
    if isinstance(stated_value, int) and stated_value.bit_length() > _MAX_BITS:
        plain = False  # Python does not print integers with thousands of digits
    value = f" (found {plain_line(repr(stated_value), _MAX_SHOWN_LENGTH)})" if plain else ""
    return f"{place}: {message}{value}{hint}" if place else message
