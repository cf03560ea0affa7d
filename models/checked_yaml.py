"""YAML files read against a typed schema: every mistake becomes one line that names the place and the remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from diffdrive_mpc.models.bounded_yaml import parse_yaml
from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.models.input_file import MEGABYTE, read_input
from diffdrive_mpc.models.plain_text import plain_line
from diffdrive_mpc.models.suggestions import suggestion

_LARGEST = 50 * MEGABYTE
_SHOWN = 100
"""Characters of a wrong value or of a key that a message repeats."""
_MOST_MISTAKES = 10
"""Mistakes that a message lists."""


class ConfigError(DiffdriveMpcError, ValueError):
    """A parameter or configuration file cannot be used. The message is one line: place, mistakes, remedies."""


class StrictModel(BaseModel):
    """Base of every schema: unknown keys are errors, values are immutable, numbers are finite."""

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)


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
        With one line that names the file and for every mistake the key, what is wrong and what would be right.
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
        raise ConfigError(mistakes(where, [_sentence(schema, detail) for detail in error.errors()])) from error


def mistakes(where: str, sentences: Sequence[str]) -> str:
    """One line that says all mistakes of what `where` names, numbered where there are several."""
    different = list(dict.fromkeys(sentences))
    if len(different) == 1:
        return f"{where}: {different[0]}"
    listed = [f"({number}) {sentence}" for number, sentence in enumerate(different[:_MOST_MISTAKES], start=1)]
    more = len(different) - len(listed)
    return f"{where}: {len(different)} mistakes: {'; '.join(listed)}{f' (and {more} more)' if more else ''}"


def _sentence(schema: type[BaseModel], error: Any) -> str:  # noqa: ANN401 - pydantic's error dictionary
    """One readable sentence for one of pydantic's errors."""
    location = [part for part in error["loc"] if not str(part).startswith("function-")]
    place = ".".join(plain_line(str(part), _SHOWN) for part in location)
    kind = error["type"]
    if kind == "extra_forbidden":
        return f"unknown key '{place}'" + suggestion(schema, location)
    if kind == "missing":
        return f"key '{place}' is missing"
    message = str(error["msg"]).removeprefix("Value error, ")
    found = error.get("input")
    plain = isinstance(found, (int, float, str, bool, type(None)))
    shown = f" (found {plain_line(repr(found), _SHOWN)})" if plain else ""
    return f"{place}: {message}{shown}" if place else message
