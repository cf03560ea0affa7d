"""YAML files read against a typed schema: every mistake becomes one line that names the place and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from diffdrive_mpc.models.bounded_yaml import parse_yaml
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.plain_text import plain_line

_LARGEST = 50 * MEGABYTE
_SHOWN = 100
"""Characters of a wrong value or of a key that a message repeats."""


class ConfigError(DiffdriveMpcError, ValueError):
    """A parameter or configuration file cannot be used. The message is one line: place, mistake, remedy."""


class StrictModel(BaseModel):
    """Base of every schema: unknown keys are errors, values are immutable, numbers are finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


Schema = TypeVar("Schema", bound=BaseModel)


def read_yaml(path: str | Path) -> Any:  # noqa: ANN401 - the schema that checks it gives it a type
    """Parse a YAML file without executing anything in it.

    Raises
    ------
    ConfigError
        If the file is missing, unreadable, no regular file or too large; if it is no YAML, has a key twice, is too deep
        or holds too much.
    """
    path = Path(path)
    try:
        text = read_input(path, _LARGEST).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    try:
        return parse_yaml(text)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(f"{path}{line}: {error.problem or 'not valid YAML'}") from error
    except yaml.YAMLError as error:
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
    place = ".".join(plain_line(str(part), _SHOWN) for part in location)
    kind = error["type"]
    if kind == "extra_forbidden":
        return f"unknown key '{place}'" + _suggestion(schema, location)
    if kind == "missing":
        return f"key '{place}' is missing"
    message = str(error["msg"]).removeprefix("Value error, ")
    found = error.get("input")
    plain = isinstance(found, (int, float, str, bool, type(None)))
    shown = f" (found {plain_line(repr(found), _SHOWN)})" if plain else ""
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
