"""The half-space as a term of the cost, and the compiled library of free space."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca

from diffdrive_mpc import core_sources

core_sources.require(1)

PARAMETERS = 5
"""Number of stage parameters: a (2), point d (2) of the robot in its own frame [m], b [m]."""

_HEADER = "free_space.h"


def half_space(pose: ca.SX, parameters: ca.SX) -> ca.SX:
    """Return the distance of the point d of the robot beyond a plane [m], no more than zero on the free side.

    It is a . (position + R(heading) d) - b, where a is a unit vector that leads to the far side.
    """
    a, d, b = parameters[:2], parameters[2:4], parameters[4]
    cosine, sine = ca.cos(pose[2]), ca.sin(pose[2])
    point = pose[:2] + ca.vertcat(cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1])
    return ca.SX(ca.dot(a, point) - b)


def half_space_formula() -> ca.Function:
    """Return that distance with its gradient, as it is in C."""
    inputs = core_sources.term_symbols(PARAMETERS)
    return core_sources.term("ddmpc_f_half_space", inputs, half_space(inputs["pose"], inputs["parameters"]))


def half_space_function() -> ca.Function:
    """Return that distance as a function that a term takes."""
    pose, parameters = ca.SX.sym("pose", 3), ca.SX.sym("parameters", PARAMETERS)
    return ca.Function(
        "half_space", [pose, parameters], [half_space(pose, parameters)], ["pose", "parameters"], ["value"]
    )


@cache
def load_free_space() -> tuple[Any, Any]:
    """Return cffi's declarations and the library of free space, compiled together with the core at first use.

    Raises
    ------
    NotCompiledError
        If there is no C compiler.
    """
    generated = core_sources.generate((half_space_formula(),), "ddmpc_half_space", "free_space/half_space.py")
    folder = Path(__file__).parent
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.[ch]"))}
    texts |= {f"{generated.stem}.c": generated.source, f"{generated.stem}.h": generated.header}
    ffi, _ = core_sources.load_core()
    return ffi, core_sources.load_with_core("ddmpc_free_space", texts, _HEADER)
