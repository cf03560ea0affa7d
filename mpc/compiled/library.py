"""Compiled C functions as callables on plain memory."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Literal, TypeVar

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.compiled.compiler import NotCompiledError, compile_library
from diffdrive_mpc.mpc.compiled.constants import sizes_header

Compiled = Literal["auto", "never", "always"]
_C = TypeVar("_C")
_Python = TypeVar("_Python")
_log = logging.getLogger(__name__)


def load_library(sources: tuple[str, ...], sizes: Mapping[str, int]) -> ctypes.CDLL:
    """The library of `sources` for these sizes, compiled if need be.

    Raises
    ------
    mpc.compiled.compiler.NotCompiledError
        If it cannot be compiled or loaded.
    """
    return _load(sources, sizes_header(sizes))


@cache
def _load(sources: tuple[str, ...], header: str) -> ctypes.CDLL:
    path = compile_library(sources, header)
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NotCompiledError(f"{path} cannot be loaded: {error}; delete it") from error


def callable_in(library: ctypes.CDLL, name: str, result: type | None, *arguments: type) -> Callable[..., Any]:
    """The function `name` of the library with the types of its result and arguments."""
    function = getattr(library, name)
    function.restype, function.argtypes = result, arguments
    return function  # type: ignore[no-any-return]


def bound_function(library: ctypes.CDLL, name: str, *addresses: ctypes.c_void_p) -> Callable[[], None]:
    """The function `name` of the library with its arguments, which never change; it returns nothing."""
    function = callable_in(library, name, None, *(ctypes.c_void_p,) * len(addresses))
    return lambda: function(*addresses)


def checked_size(library: ctypes.CDLL, name: str) -> int:
    """Size in bytes that the library's function `name` says."""
    return int(callable_in(library, name, ctypes.c_ulong)())


def checked_constants(library: ctypes.CDLL, name: str, values: FloatArray) -> FloatArray:
    """`values`, if they fill the struct whose size the function `name` says.

    Raises
    ------
    ValueError
        If they do not: the C struct and `mpc.compiled.constants` have gone different ways.
    """
    if checked_size(library, name) != values.nbytes:
        raise ValueError(f"{name}: {checked_size(library, name)} bytes, but the constants have {values.nbytes}")
    return values


def pointer(memory: np.ndarray[Any, Any]) -> ctypes.c_void_p:
    """Address of an array, made once: asking for it takes longer than most functions here."""
    return ctypes.c_void_p(memory.ctypes.data)


def compiled_or_not(choice: Compiled, compiled: Callable[[], _C], interpreted: Callable[[], _Python]) -> _C | _Python:
    """Build a part in C, or in Python where that is asked for or C cannot be had.

    Raises
    ------
    models.checked_yaml.ConfigError
        If it must be compiled and cannot be.
    """
    if choice == "never":
        return interpreted()
    try:
        return compiled()
    except NotCompiledError as error:
        if choice == "always":
            raise ConfigError(f"solver.compiled = always: {error}; install gcc, or set it to auto") from error
        _warn_once(str(error))
        return interpreted()


@cache
def _warn_once(reason: str) -> None:
    _log.warning("the controller runs in Python, which is slower: %s", reason)
