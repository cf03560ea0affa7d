"""The compiled core inside a wheel: one library for each level of x86-64.

A wheel runs on processors that its maker has not seen. On x86-64 the core is therefore compiled for the levels 3 and 4
of the architecture too (AVX2, AVX-512), and the best one that the processor has is loaded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from diffdrive_mpc.models.compiled.compiler import PLAIN_REST, digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged
from diffdrive_mpc.mpc.core.sources import CORE, core_origin, core_texts

_V3 = frozenset(("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"))
_V4 = _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
_LEVELS = {
    "x86-64-v4": Level(("-march=x86-64-v4", "-mprefer-vector-width=512", PLAIN_REST), _V4),
    "x86-64-v3": Level(("-march=x86-64-v3",), _V3),
    BASELINE: Level((), frozenset()),
}


def write_packaged(folder: Path) -> list[Path]:
    """Compile the core for the package in `folder`: libraries and manifest; without the levels that the compiler lacks.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled at all.
    """
    return _packaged().write(core_texts(), folder)


def packaged_libraries() -> Iterator[Path]:
    """Yield the package's libraries that this processor can run, best first; skip incomplete or outdated ones."""
    return _packaged().libraries()


def packaged_with_core(name: str, folder: Path, sources: Sequence[str]) -> Packaged:
    """Return the library of another package whose C is compiled together with the core, at the levels of the core.

    Parameters
    ----------
    name
        First part of the file names of the library.
    folder
        Folder of the library in a wheel of that package.
    sources
        Texts that the further C comes from, before anything is generated.
    """
    return Packaged(name, folder, digest_of([core_origin(), *sources]), _LEVELS)


def _packaged() -> Packaged:
    return Packaged("ddmpc_core", CORE, core_origin(), _LEVELS)
