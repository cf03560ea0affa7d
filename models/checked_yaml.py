"""YAML files read against a typed schema: every mistake becomes one line that names the place and the remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from diffdrive_mpc.models.errors import DiffdriveMpcError

try:
    from yaml import CSafeLoader as SafeLoader  # ten times as quick
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]


class ConfigError(DiffdriveMpcError, ValueError):
    """A parameter or configuration file cannot be used. The message is one line: place, mistake, remedy."""


class StrictModel(BaseModel):
    """Base of every schema: unknown keys are errors, values are immutable, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Schema = TypeVar("Schema", bound=BaseModel)


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


def read_yaml(path: str | Path) -> Any:  # noqa: ANN401 - the schema that checks it gives it a type
    """Parse a YAML file without executing anything in it.

    Raises
    ------
    ConfigError
        If the file is missing, unreadable, no YAML, or has a key twice.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    try:
        return yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{path}{line}: {error.problem or 'not valid YAML'}") from error
    except (yaml.YAMLError, ValueError) as error:  # a date such as 2020-13-40 is a ValueError
        raise ConfigError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from error


def load_checked(schema: type[Schema], path: str | Path) -> Schema:
    """Read the YAML file at `path` and check it against `schema`.

    Raises
    ------
    ConfigError
        With one line that names the file, the key, what is wrong and what would be right.
    """
    return check(schema, read_yaml(path), str(path))


def load_variation(schema: type[Schema], path: str | Path, base: Mapping[str, Any]) -> Schema:
    """Read a YAML file that says only where it differs from `base`, values by key, and check the whole.

    Groups are laid over those of `base` key by key; anything else, lists included, takes the place of what was there.

    Raises
    ------
    ConfigError
        As for `load_checked`.
    """
    data = read_yaml(path)
    return check(schema, laid_over(base, data) if isinstance(data, Mapping) else data, str(path))


def laid_over(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `changes` in place of its own, groups key by key."""
    whole = dict(base)
    for key, value in changes.items():
        under = whole.get(key)
        whole[key] = laid_over(under, value) if isinstance(under, Mapping) and isinstance(value, Mapping) else value
    return whole


def check(schema: type[Schema], data: object, where: str) -> Schema:
    """Check `data` against `schema`; `where` names its source in the error message.

    Raises
    ------
    ConfigError
        As for `load_checked`.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(
            f"{where}: expected keys and values, found {'nothing' if data is None else type(data).__name__}"
        )
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        more = error.error_count() - 1
        tail = f" (and {more} more)" if more else ""
        raise ConfigError(f"{where}: {_sentence(schema, first)}{tail}") from error


def _sentence(schema: type[BaseModel], error: Any) -> str:  # noqa: ANN401 - pydantic's error dictionary
    """One readable sentence for one of pydantic's errors."""
    location = [part for part in error["loc"] if not str(part).startswith("function-")]
    place = ".".join(str(part) for part in location)
    kind = error["type"]
    if kind == "extra_forbidden":
        return f"unknown key '{place}'" + _suggestion(schema, location)
    if kind == "missing":
        return f"key '{place}' is missing"
    message = str(error["msg"]).removeprefix("Value error, ")
    found = error.get("input")
    shown = f" (found {found!r})" if isinstance(found, (int, float, str, bool, type(None))) else ""
    return f"{place}: {message}{shown}" if place else message


def _suggestion(schema: type[BaseModel], location: list[Any]) -> str:
    """The known key nearest to the unknown one, looked for beside it and then in the whole schema."""
    *parents, key = [str(part) for part in location]
    level: type[BaseModel] | None = schema
    for parent in parents:
        level = _child(level, parent) if level else None
    known = list(level.model_fields) if level else []
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    if near:
        return f"; did you mean '{'.'.join([*parents, near[0]])}'?"
    elsewhere = {path.rsplit(".", 1)[-1]: path for path in _paths(schema)}
    near = difflib.get_close_matches(key, elsewhere, n=1, cutoff=0.7)
    if near:
        return f"; did you mean '{elsewhere[near[0]]}'?"
    return f"; known keys: {', '.join(known)}" if known else ""


def _child(level: type[BaseModel], name: str) -> type[BaseModel] | None:
    field = level.model_fields.get(name)
    if field is None:
        return None
    for candidate in (field.annotation, *get_args(field.annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _paths(schema: type[BaseModel], prefix: str = "") -> list[str]:
    paths: list[str] = []
    for name in schema.model_fields:
        paths.append(prefix + name)
        child = _child(schema, name)
        if child:
            paths.extend(_paths(child, f"{prefix}{name}."))
    return paths
