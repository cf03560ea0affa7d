"""Loading of the compiled parts of plants through cffi; the headers in this folder document them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cffi
import numpy as np

from diffdrive_mpc.models.compiled.compiler import digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged, loaded_once
from diffdrive_mpc.models.interface import FloatArray

CORE = Path(__file__).parent
"""Folder of the C files and headers."""

# Contraction is disabled, and code is not tuned to the processor, so that results are bitwise equal on all machines.
_FLAGS = ("-ffp-contract=off",)
_NAMES = ("twin", "velocity_plant", "sensors", "closed_loop", "polyline")
_STEP = "void mj_step(const void *model, void *data);"


@loaded_once
def load_twin() -> tuple[cffi.FFI, Any]:
    """Load the library; return the FFI with the declarations of the headers, and the library.

    Raises
    ------
    NotCompiledError
        If no packaged library can be loaded and the library cannot be compiled.
    """
    headers = "".join(_texts()[f"{name}.h"] for name in _NAMES)
    declarations = re.sub(r"^\s*#.*$", "", headers, flags=re.MULTILINE)
    message = "the simulated robot is not compiled: {}, which contains it"
    return _packaged().load(_texts(), declarations, message)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the drivetrain to a library in `folder` and write the manifest.

    Raises
    ------
    NotCompiledError
        If the compilation fails.
    """
    return _packaged().write(_texts(), folder)


def address(array: FloatArray) -> Any:  # noqa: ANN401 - cffi has no types
    """Return the C address of an array's data; the array must outlive its use in C."""
    return load_twin()[0].cast("double *", array.ctypes.data)


def view(numbers: Any) -> FloatArray:  # noqa: ANN401 - cffi has no types
    """Return a view of an array field of a struct; the struct must outlive the view."""
    return np.frombuffer(load_twin()[0].buffer(numbers), dtype=float)


@loaded_once
def physics_step() -> Any:  # noqa: ANN401 - cffi has no types
    """Return the C function `mj_step` of the library in MuJoCo's Python package; None if it is not found.

    The drivetrain uses it to call the physics from C, ten times per control sample.
    """
    import mujoco  # noqa: PLC0415 - an optional dependency

    ffi = cffi.FFI()
    ffi.cdef(_STEP)
    version = re.escape(mujoco.mj_versionString())
    for path in sorted(Path(mujoco.__file__).parent.iterdir()):
        if re.fullmatch(rf"libmujoco\.(so\.)?{version}(\.dylib)?", path.name):
            try:
                # The loader returns the library that is already loaded instead of a second copy.
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
