"""The half-space as a term of the cost, and the compiled library of free space."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca

from diffdrive_mpc import core_sources
from diffdrive_mpc.models.compiled.packaged import Packaged

core_sources.require(1)

PARAMETERS = 5
"""Number of stage parameters: a (2), point d (2) of the robot in its own frame [m], b [m]."""

_FOLDER = Path(__file__).parent


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
    """Return cffi's declarations and the library of free space: of the wheel, else compiled with the core at first use.

    Raises
    ------
    NotCompiledError
        If the wheel holds no library, and there is no C compiler.
    """
    ffi, _ = core_sources.load_core()
    header = (_FOLDER / "free_space.h").read_text(encoding="utf-8")
    return ffi, core_sources.load_with_core(_packaged(), _texts, header)


def packaged_libraries() -> Iterator[Path]:
    """Yield the libraries of the wheel that this processor can run, best first."""
    return _packaged().libraries()


def write_packaged(folder: Path) -> list[Path]:
    """Compile free space for the wheel in `folder`: libraries and manifest.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled.
    """
    return _packaged().write(_texts(), folder)


def _packaged() -> Packaged:
    sources = [path.read_text(encoding="utf-8") for path in [*sorted(_FOLDER.glob("*.[ch]")), Path(__file__)]]
    return core_sources.packaged_with_core("ddmpc_free_space", _FOLDER, sources)


def _texts() -> dict[str, str]:
    """Return all C files and headers by name, those of the core and the generated ones included."""
    generated = core_sources.generate((half_space_formula(),), "ddmpc_half_space", "free_space/half_space.py")
    written = {path.name: path.read_text(encoding="utf-8") for path in sorted(_FOLDER.glob("*.[ch]"))}
    return (
        core_sources.core_texts()
        | written
        | {
            f"{generated.stem}.c": generated.source,
            f"{generated.stem}.h": generated.header,
        }
    )
