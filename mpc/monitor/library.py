"""The judge through cffi; `mpc/monitor/core/judge.h` says what is in it."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import cffi

from diffdrive_mpc.models.compiled.compiler import build_library, digest_of
from diffdrive_mpc.models.compiled.packaged import BASELINE, Level, Packaged, load_library

CORE = Path(__file__).parent / "core"
"""Folder of the C file and its header."""
SOURCES = ("judge.c", "judge.h")

# The same bits on every processor: what the monitor of a microcontroller decides can be looked at on a desk.
_FLAGS = ("-ffp-contract=off",)


@cache
def load_judge() -> tuple[cffi.FFI, Any]:
    """The judge: cffi's declarations of `judge.h`, and the library.

    Raises
    ------
    NotCompiledError
        If the package brought no library, and none can be compiled.
    """

    def build(folder: Path) -> Path:
        return build_library(source_texts(), folder, [_FLAGS])

    header = re.sub(r"^\s*#.*$", "", source_texts()["judge.h"], flags=re.MULTILINE)
    declarations = header.replace("DDMON_EXPORT ", "")
    made_of = source_texts() | {"flags": repr(_FLAGS)}
    complaint = "the monitor's judge is not compiled: {}, which holds it"
    return load_library("ddmpc_monitor", declarations, _packaged().libraries(), made_of, build, complaint)


def write_packaged(folder: Path) -> list[Path]:
    """Compile the judge for the package in `folder`: library and manifest.

    Raises
    ------
    NotCompiledError
        If it cannot be compiled.
    """
    return _packaged().write(source_texts(), folder)


def source_texts() -> dict[str, str]:
    """Text of each source by its name."""
    return {name: (CORE / name).read_text(encoding="utf-8") for name in SOURCES}


def _packaged() -> Packaged:
    origin = digest_of([*source_texts().values(), *_FLAGS])
    return Packaged("ddmpc_monitor", CORE, origin, {BASELINE: Level(_FLAGS, frozenset())})
