"""Compiled core in a wheel: one library for each level of x86-64.

The processor of the user is unknown when a wheel is built. On x86-64 the core is therefore compiled for the baseline
and for the levels 3 (AVX2) and 4 (AVX-512) of the architecture, and the highest level that the processor supports is
loaded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from diffdrive_mpc.models.compiled.compiler import NO_VECTOR_EPILOGUES, digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged
from diffdrive_mpc.mpc.core.sources import CORE, core_origin, core_texts

_V3 = frozenset(("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"))
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_LEVELS = {
    "x86-64-v4": Level(("-march=x86-64-v4", "-mprefer-vector-width=512", NO_VECTOR_EPILOGUES), _V4),
    "x86-64-v3": Level(("-march=x86-64-v3",), _V3),
    BASELINE: Level((), frozenset()),
}


def write_packaged(folder: Path) -> list[Path]:
    """Compile the core into `folder` of a package; return libraries and manifest.

    Levels that the compiler does not support are skipped.

    Raises
    ------
    NotCompiledError
        If the baseline cannot be compiled.
    """
    return _packaged().write(core_texts(), folder)


def packaged_libraries() -> Iterator[Path]:
    """Yield the package's libraries for this processor, highest level first; skip incomplete and outdated libraries."""
    return _packaged().libraries()


def packaged_with_core(name: str, folder: Path, sources: Sequence[str]) -> Packaged:
    """Return the library of another package whose C code is compiled together with the core, for the same levels.

    Parameters
    ----------
    name
        Prefix of the file names of the library.
    folder
        Folder of the library in the wheel of the package.
    sources
        Source texts of the additional C code, before code generation.
    """
    return Packaged(name, folder, digest_of([core_origin(), *sources]), _LEVELS)


def _packaged() -> Packaged:
    return Packaged("ddmpc_core", CORE, core_origin(), _LEVELS)
