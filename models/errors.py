"""Common base of all errors of the project, and errors about arguments."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import isfunction, signature
from typing import Any, ParamSpec, TypeVar

from diffdrive_mpc.models.table import escape

P = ParamSpec("P")
R = TypeVar("R")
C = TypeVar("C")
_TYPE_MISTAKE = re.compile(
    r"could not convert|broadcast|inhomogeneous|must be real number|expected str, bytes|to be integer|"
    r"(?:argument of type )?'(\w+)'(?: object)? (has no|is not|cannot|does not)"
)
"""Messages of Python and NumPy for arguments of a wrong type or shape; the group is the name of the type."""
_MAX_VALUE_LENGTH = 40
"""Maximum number of characters of a value in a message."""
_MAX_LENGTH = 4000
"""Maximum number of characters of a message."""


def _one_line(message: str) -> str:
    # Truncate first, to limit the work for long texts.
    text = escape(re.sub(r"\s*\n\s*", " ", message[:_MAX_LENGTH]))
    return text if len(text) <= _MAX_LENGTH and len(message) <= _MAX_LENGTH else f"{text[: _MAX_LENGTH - 3]}..."


class DiffdriveMpcError(Exception):
    """Base of the project's errors; the message is one line with place, mistake and remedy.

    Most subclasses are also a ValueError or a RuntimeError. An argument that only a programming error can cause, such
    as an array of the wrong shape, raises a plain ValueError instead.

    Control characters in the message are escaped, because names in it may come from untrusted files.
    """

    def __init__(self, *parts: object) -> None:
        super().__init__(*(_one_line(part) if isinstance(part, str) else part for part in parts))


class MissingPackageError(DiffdriveMpcError, ImportError):
    """Error for a feature whose package is not installed; its message states how to install it."""


class NoteWarning(UserWarning):
    """Base of warnings that commands print as a note of one line."""

    def __init__(self, message: str = "") -> None:
        super().__init__(_one_line(message))


class UnusualValueWarning(NoteWarning):
    """Warning for a value that is valid but probably has another unit."""


class ArgumentError(DiffdriveMpcError, TypeError):
    """Error for an argument of an unusable type: one line with argument, expected type, actual type and remedy."""


def wrong_type(argument: str, expected: str, value: object, remedy: str) -> ArgumentError:
    """Build the error for a `value` of `argument` that has another type than `expected`."""
    return ArgumentError(f"{argument}: expected {expected}, got {describe_type(value)}; {remedy}")


def checked_call(no_argument: str = "", **remedies: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that raises ArgumentError for a missing or unknown argument; the message lists all arguments.

    It also raises ArgumentError instead of errors of Python and NumPy about the type or shape of an argument.

    `remedies` are hints by name, for names that are arguments of another function; `no_argument` is the hint for every
    argument of a function without arguments.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return function(*args, **kwargs)
            except (TypeError, ValueError, AttributeError) as error:
                # An error of the call itself is raised before the function has a frame.
                if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                    arguments = signature(function).bind(*args, **kwargs).arguments
                    described = _describe_types(error, function.__qualname__, arguments)
                    if described is None:
                        raise
                    raise described from error
                from diffdrive_mpc.models.suggestions import similar_name  # noqa: PLC0415 - needed in case of an error

                names = [str(p).partition(":")[0] for p in signature(function).parameters.values()]
                known = [name for name in names if name not in ("self", "cls")]
                unknown = [name for name in kwargs if name not in known]
                name = unknown[0] if unknown else ""
                message = str(error).replace(".__init__()", "()")
                if not known and no_argument:
                    raise ArgumentError(f"{message}; {no_argument}") from error
                hint = f"; {remedies[name]}" if name in remedies else similar_name(name, known)
                raise ArgumentError(f"{message}{hint}; the arguments are {', '.join(known)}") from error

        return wrapper

    return decorate


def _describe_types(error: Exception, function: str, arguments: Mapping[str, object]) -> ArgumentError | None:
    """Return the ArgumentError for an error about the type or shape of an argument, which it names; otherwise None."""
    match = None if isinstance(error, DiffdriveMpcError) else _TYPE_MISTAKE.search(str(error))
    wrong = {name: value for name, value in arguments.items() if match and type(value).__name__ == match[1]}
    if match is None or (match[1] and not wrong):
        return None
    listed = ", ".join(f"{k} = {describe_type(v)}" for k, v in (wrong or arguments).items() if k not in ("self", "cls"))
    return ArgumentError(f"{function}: {error} ({listed}); give the types and shapes of its help")


def checked_methods(kind: type[C]) -> type[C]:
    """Apply `checked_call` to the constructor and to the public methods of a class."""
    for name, value in list(vars(kind).items()):
        function = getattr(value, "__func__", value)
        if isfunction(function) and (name == "__init__" or not name.startswith("_")):
            checked = checked_call()(function)
            setattr(kind, name, checked if function is value else type(value)(checked))
    return kind


def checked_number(argument: str, value: object, remedy: str) -> float:
    """Return `value` as a float; raise ArgumentError if it is a string or cannot be converted."""
    try:
        if not isinstance(value, (str, bytes)):
            return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        pass
    raise wrong_type(argument, "a number", value, remedy)


def describe_type(value: object) -> str:
    """Describe the type of a value, with its shape or, if short, the value itself."""
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
    return f"{name} {text}" if package == "builtins" and len(text) <= _MAX_VALUE_LENGTH and "<" not in text else name


def load_pandas(caller: str) -> Any:  # noqa: ANN401 - a module
    """Import pandas for the function `caller`; raise MissingPackageError if it is not installed."""
    try:
        import pandas as pd  # noqa: PLC0415 - loads slowly
    except ImportError as error:
        raise MissingPackageError(f"{caller} needs pandas: pip install pandas") from error
    return pd
