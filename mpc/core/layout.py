"""The structs of core.h by the names of their fields: shapes of what they point to, and values that fit.

`core.h` is the only place that knows how memory is laid out. Its text declares the structs to cffi, and the shapes of
what they point to stand in it beside each pointer.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.core.library import load_core
from diffdrive_mpc.mpc.core.sources import header_text
from diffdrive_mpc.mpc.problem.constants import Constants, padded

_POINTER = re.compile(r"^\s*(?:const )?(?:real|ddmpc_time|int) \*(\w+);\s*/\* ((?:\[[^\]]+\])+)", re.MULTILINE)
_STRUCT = re.compile(r"typedef struct \{(.*?)\} (\w+);", re.DOTALL)


def pointer_shapes(struct: str, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Shapes of what the pointers of a struct of core.h point to, by name, for these sizes of a controller."""
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
        "width": padded(2 * N),
    }
    (body,) = (body for body, name in _STRUCT.findall(header_text()) if name == struct)
    return {
        name: tuple(_value(part, symbols) for part in re.findall(r"\[([^\]]+)\]", brackets))
        for name, brackets in _POINTER.findall(body)
    }


def _value(expression: str, symbols: Mapping[str, int]) -> int:
    """A sum of products of symbols and numbers."""
    total = 0
    for summand in expression.strip("()").replace("(", "").split("+"):
        product = 1
        for factor in summand.split("*"):
            product *= symbols[factor] if factor in symbols else int(factor)
        total += product
    return total


class Field(NamedTuple):
    """One field of `ddmpc_constants` with its value."""

    name: str
    value: FloatArray | list[float] | float | int
    """What a pointer points to; the numbers of an array; or one number."""


def constant_fields(sizes: Mapping[str, int], values: Constants) -> Iterator[Field]:
    """The fields of `ddmpc_constants` in their order.

    Raises
    ------
    ValueError
        If a field is missing, unknown, or of another shape than core.h says.
    """
    ffi, _ = load_core()
    fields = dict(ffi.typeof("ddmpc_constants").fields)
    shapes = pointer_shapes("ddmpc_constants", sizes)
    odd = set(fields) ^ set(values)
    if odd:
        raise ValueError(f"ddmpc_constants and mpc/problem/constants.py differ in {', '.join(sorted(odd))}")
    for name, field in fields.items():
        if field.type.kind == "pointer":
            yield Field(name, _shaped(name, values[name], shapes[name]))
        elif field.type.kind == "array":
            flat = np.asarray(values[name], dtype=float).ravel()
            yield Field(name, _shaped(name, flat, (field.type.length,)).tolist())
        else:
            number: float = values[name]  # type: ignore[assignment]
            yield Field(name, int(number) if field.type.cname == "int" else float(number))


def _shaped(name: str, value: object, shape: tuple[int, ...]) -> FloatArray:
    given: ArrayLike = value  # type: ignore[assignment]
    array = np.ascontiguousarray(given, dtype=float)
    if array.shape != shape:
        raise ValueError(f"ddmpc_constants.{name} has shape {array.shape}, core.h says {shape}")
    return array
