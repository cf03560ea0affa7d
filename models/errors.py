"""The common base of all errors that the project defines."""

from __future__ import annotations

import re
from typing import Any

from diffdrive_mpc.models.table import escaped

_LONGEST_VALUE = 40
"""Characters of a value that a message repeats."""
_LONGEST = 4000
"""Characters of a message."""


def _shown(message: str) -> str:
    text = escaped(re.sub(r"\s*\n\s*", " ", message[:_LONGEST]))
    return text if len(text) <= _LONGEST and len(message) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


class DiffdriveMpcError(Exception):
    """Error of the project itself; its message is one line: place, mistake, remedy.

    Most of its kinds are a ValueError or a RuntimeError too. An argument that only a programming error can cause (the
    wrong shape of an array) raises a plain ValueError instead.

    Names in a message may come from untrusted files: control characters are escaped.
    """

    def __init__(self, *parts: object) -> None:
        super().__init__(*(_shown(part) if isinstance(part, str) else part for part in parts))


class MissingPackageError(DiffdriveMpcError, ImportError):
    """Error for a feature whose package is not installed; its message states how to install it."""


class FormerNameWarning(UserWarning):
    """A file states something under a name that it had in an earlier version; it is read all the same."""

    def __init__(self, message: str = "") -> None:
        super().__init__(_shown(message))


class ArgumentError(DiffdriveMpcError, TypeError):
    """An argument has a type that cannot be used. One line: argument, expected type, actual type, how to make it."""


def wrong_type(argument: str, expected: str, value: object, remedy: str) -> ArgumentError:
    """Make the error for `value`, which arrived as `argument` where something else is expected."""
    return ArgumentError(f"{argument}: expected {expected}, got {described(value)}; {remedy}")


def checked_number(argument: str, value: object, remedy: str) -> float:
    """Return `value` as a float; raise ArgumentError if it is a text or no number at all."""
    try:
        if not isinstance(value, (str, bytes)):
            return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        pass
    raise wrong_type(argument, "a number", value, remedy)


def described(value: object) -> str:
    """Describe the type of a value, with its shape or, if it is short, the value."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    kind = type(value)
    package = kind.__module__.partition(".")[0]
    name = kind.__name__ if package in ("builtins", __package__.partition(".")[0]) else f"{package}.{kind.__name__}"
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple):
        return f"{name} of shape {shape}"
    text = repr(value)
    return f"{name} {text}" if package == "builtins" and len(text) <= _LONGEST_VALUE and "<" not in text else name


# pandas, loaded where rows become a table and nowhere else.


def load_pandas(wanted_by: str) -> Any:  # noqa: ANN401 - a module
    """Import pandas for `wanted_by`; raises MissingPackageError where it is not installed."""
    try:
        import pandas as pd  # noqa: PLC0415 - loads slowly
    except ImportError as error:
        raise MissingPackageError(f"{wanted_by} needs pandas: pip install pandas") from error
    return pd
