"""The compiled parts of plants, loaded through cffi; the headers in this folder describe them."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import cffi
import numpy as np

from diffdrive_mpc.models.compiled.compiler import digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged
from diffdrive_mpc.models.interface import FloatArray

CORE = Path(__file__).parent
"""Folder of the C file and its header."""

# No contraction and no tuning to the processor: the same seed must give the same bits everywhere.
_FLAGS = ("-ffp-contract=off",)
_NAMES = ("twin", "velocity_plant")
_STEP = "void mj_step(const void *model, void *data);"


@cache
def load_twin() -> tuple[cffi.FFI, Any]:
    """Load the library: cffi's declarations of the headers, and the library.

    Raises
    ------
    NotCompiledError
        If the package brought no library, and none can be compiled.
    """
    headers = "".join(_texts()[f"{name}.h"] for name in _NAMES)
    declarations = re.sub(r"^\s*#.*$", "", headers, flags=re.MULTILINE)
    complaint = "the simulated robot is not compiled: {}, which holds it"
    return _packaged().load(_texts(), declarations, complaint)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the drivetrain for the package in `folder`: library and manifest.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled.
    """
    return _packaged().write(_texts(), folder)


def address(array: FloatArray) -> Any:  # noqa: ANN401 - cffi has no types
    """Return the C address of an array's numbers; the array must live as long as C reads them."""
    return load_twin()[0].cast("double *", array.ctypes.data)


def view(numbers: Any) -> FloatArray:  # noqa: ANN401 - cffi has no types
    """View an array field of a struct as an array, without a copy; the struct must live as long."""
    return np.frombuffer(load_twin()[0].buffer(numbers), dtype=float)


@cache
def physics_step() -> Any:  # noqa: ANN401 - cffi has no types
    """Find `mj_step` for C in the library that MuJoCo's Python package has loaded; return None without success.

    C then calls the physics without Python, ten times per control sample.
    """
    import mujoco  # noqa: PLC0415 - an optional dependency

    ffi = cffi.FFI()
    ffi.cdef(_STEP)
    version = re.escape(mujoco.mj_versionString())
    for path in sorted(Path(mujoco.__file__).parent.iterdir()):
        if re.fullmatch(rf"libmujoco\.(so\.)?{version}(\.dylib)?", path.name):
            try:
                # The loader gives the library that is loaded already, not another copy.
                library = ffi.dlopen(str(path))
                return load_twin()[0].cast("void *", ffi.cast("uintptr_t", ffi.addressof(library, "mj_step")))
            except (OSError, AttributeError):
                continue
    return None


def _texts() -> dict[str, str]:
    return {file: (CORE / file).read_text(encoding="utf-8") for name in _NAMES for file in (f"{name}.c", f"{name}.h")}


def _packaged() -> Packaged:
    origin = digest_of([*_texts().values(), *_FLAGS])
    return Packaged("ddmpc_twin", CORE, origin, {BASELINE: Level(_FLAGS, frozenset())})
