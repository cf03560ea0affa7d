"""Loading of the compiled core and of compiled user functions through cffi.

The core is loaded from the wheel if the wheel contains it. Otherwise it is compiled for this processor at first use,
and stored in the user's cache (`models/compiled/cache.py`). cffi parses the text of the core's header, so Python and C
use the same names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import cffi
import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.compiled.cache import load_cached
from diffdrive_mpc.models.compiled.compiler import NATIVE, NotCompiledError, build_digest, build_library
from diffdrive_mpc.models.compiled.packaged import Packaged, load_library, loaded_once
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.core.packaged import packaged_libraries
from diffdrive_mpc.mpc.core.sources import (
    core_declarations,
    core_origin,
    core_texts,
    declarations,
    header_text,
    shared_headers,
)
from diffdrive_mpc.mpc.problem.constants import Constants, round_up

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.core.generate import GeneratedC


_FUNCTION = "int {name}(const real **, real **, long long *, real *, int);"


@loaded_once
def load_core() -> tuple[cffi.FFI, Any]:
    """Load the core; return cffi's declarations of `mpc/core/core.h`, and the library.

    Raises
    ------
    NotCompiledError
        If the package contains no library, and it cannot be compiled.
    """

    def build(folder: Path) -> Path:
        return build_library(core_texts(), folder, NATIVE)

    build_inputs = {"core": core_origin(), "casadi": ca.CasadiMeta.version()}
    message = "the controller's core is not compiled: {}, which holds the core"
    return load_library("ddmpc_core", core_declarations(), packaged_libraries(), build_inputs, build, message)


@loaded_once
def load_functions(generated: GeneratedC) -> Any:  # noqa: ANN401 - cffi has no type for a library
    """Load the library of generated functions, which are attributes of the result and use the types of the core.

    Raises
    ------
    NotCompiledError
        If the functions cannot be compiled; user functions need a C compiler.
    """
    texts = shared_headers() | {f"{generated.stem}.c": generated.source, f"{generated.stem}.h": generated.header}
    declared = "\n".join(_FUNCTION.format(name=name) for name in generated.names)
    try:
        return _load(generated.stem, texts, declared)
    except NotCompiledError as error:
        raise NotCompiledError(f"user functions cannot be compiled: {error}; install gcc") from error


def load_with_core(packaged: Packaged, texts: Callable[[], Mapping[str, str]], header: str) -> Any:  # noqa: ANN401 - as above
    """Load a library of additional C code together with the core, with the types of `load_core`.

    The library is loaded from the wheel of its package, or compiled at first use. The additional functions may include
    the core's internal headers and take the structs of a running controller as arguments.

    Parameters
    ----------
    packaged
        Library of `packaged_with_core`.
    texts
        Function that returns all C files and headers by name, including those of the core.
    header
        Text of the header that declares the library's functions.

    Raises
    ------
    NotCompiledError
        If no wheel contains the library, and it cannot be compiled.
    """
    ffi, _ = load_core()
    declared = declarations(header)
    ffi.cdef(declared, override=True)
    for path in packaged.libraries():
        # Skip wheels that were built for a different C runtime library.
        with suppress(OSError):
            return ffi.dlopen(str(path))
    return _load(packaged.name, texts(), declared)


def _load(stem: str, texts: Mapping[str, str], declared: str) -> Any:  # noqa: ANN401 - as above
    ffi, _ = load_core()
    # `override`, since user functions of several controllers have the same names.
    ffi.cdef(declared, override=True)

    def build(folder: Path) -> Path:
        return build_library(texts, folder, NATIVE)

    return load_cached(stem, build_digest(texts), build, lambda path: ffi.dlopen(str(path)))


# Pointer fields of core.h with the shapes in their comments, and structs of core.h.
_POINTER = re.compile(r"^\s*(?:const )?(?:real|ddmpc_time|int) \*(\w+);\s*/\* ((?:\[[^\]]+\])+)", re.MULTILINE)
_STRUCT = re.compile(r"typedef struct \{(.*?)\} (\w+);", re.DOTALL)


def pointer_shapes(struct: str, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays that a struct of core.h points to, by field name, for given sizes."""
    N, n = sizes["steps"], sizes["states"]
    symbols = {
        "N": N,
        "n": n,
        "W": sizes["window"],
        "K": sizes["soft"],
        "H": sizes["history"],
        "P": sizes["parameters"],
        "S": sizes["slips"],
        "Q": sizes["model_parameters"],
        "width": round_up(2 * N),
    }
    return {
        name: tuple(_value(part, symbols) for part in expressions) for name, expressions in _pointers(struct).items()
    }


@cache
def _pointers(struct: str) -> dict[str, list[str]]:
    """Return the expressions for the sizes of the arrays that a struct of core.h points to, by field name."""
    (body,) = (body for body, name in _STRUCT.findall(header_text()) if name == struct)
    return {name: re.findall(r"\[([^\]]+)\]", brackets) for name, brackets in _POINTER.findall(body)}


def _value(expression: str, symbols: Mapping[str, int]) -> int:
    """Evaluate a sum of products of symbols and numbers."""
    total = 0
    for summand in expression.strip("()").replace("(", "").split("+"):
        product = 1
        for factor in summand.split("*"):
            product *= symbols[factor] if factor in symbols else int(factor)
        total += product
    return total


class Field(NamedTuple):
    """Field of `ddmpc_constants` with its value."""

    name: str
    value: FloatArray | list[float] | float | int
    """Array for a pointer, list for an embedded array, or number."""


def constant_fields(sizes: Mapping[str, int], values: Constants) -> Iterator[Field]:
    """Yield the fields of `ddmpc_constants` in the order of the struct.

    Raises
    ------
    ValueError
        If a field is missing or unknown, or its shape differs from the one in core.h.
    """
    ffi, _ = load_core()
    fields = dict(ffi.typeof("ddmpc_constants").fields)
    shapes = pointer_shapes("ddmpc_constants", sizes)
    differing = set(fields) ^ set(values)
    if differing:
        raise ValueError(f"ddmpc_constants and mpc/problem/constants.py differ in {', '.join(sorted(differing))}")
    for name, field in fields.items():
        if field.type.kind == "pointer":
            yield Field(name, _checked_array(name, values[name], shapes[name]))
        elif field.type.kind == "array":
            flat = np.asarray(values[name], dtype=float).ravel()
            yield Field(name, _checked_array(name, flat, (field.type.length,)).tolist())
        else:
            number: float = values[name]  # type: ignore[assignment]
            yield Field(name, int(number) if field.type.cname == "int" else float(number))


def _checked_array(name: str, value: object, shape: tuple[int, ...]) -> FloatArray:
    array_like: ArrayLike = value  # type: ignore[assignment]
    array = np.ascontiguousarray(array_like, dtype=float)
    if array.shape != shape:
        raise ValueError(f"ddmpc_constants.{name} has shape {array.shape}, core.h requires {shape}")
    return array
