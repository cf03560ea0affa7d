"""Sources of the compiled core, for packages that compile C with it.

A package requires the version that it was written for, and compiles the sources:

    from diffdrive_mpc import core_sources

    core_sources.require(1)
    texts = core_sources.core_texts() | {"mine.c": ...}

`VERSION` changes with every change that such packages must follow: of a header, of the constants of the core, or of a
name below. The names are imported on first use, because generating C loads CasADi.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.core.generate import OUTPUT, STEP, GeneratedC, generate, generated_functions, term_name
    from diffdrive_mpc.mpc.core.library import constant_fields, load_core, load_with_core
    from diffdrive_mpc.mpc.core.packaged import packaged_with_core
    from diffdrive_mpc.mpc.core.sources import CORE, SIZES, core_texts
    from diffdrive_mpc.mpc.core.tick import Tick
    from diffdrive_mpc.mpc.problem.build import build_problem, chosen_model
    from diffdrive_mpc.mpc.problem.constants import HARD_KINDS, Problem
    from diffdrive_mpc.mpc.problem.formulas import term, term_symbols
    from diffdrive_mpc.mpc.problem.terms import all_terms, parameter_places

VERSION = 1
"""Version of the sources and of the names of this module."""

__all__ = [
    "CORE",
    "HARD_KINDS",
    "OUTPUT",
    "SIZES",
    "STEP",
    "VERSION",
    "GeneratedC",
    "Problem",
    "Tick",
    "all_terms",
    "build_problem",
    "chosen_model",
    "constant_fields",
    "core_texts",
    "generate",
    "generated_functions",
    "load_core",
    "load_with_core",
    "packaged_with_core",
    "parameter_places",
    "require",
    "term",
    "term_name",
    "term_symbols",
]

_NAMES = {
    "mpc.core.generate": ("OUTPUT", "STEP", "GeneratedC", "generate", "generated_functions", "term_name"),
    "mpc.core.library": ("constant_fields", "load_core", "load_with_core"),
    "mpc.core.packaged": ("packaged_with_core",),
    "mpc.core.sources": ("CORE", "SIZES", "core_texts"),
    "mpc.core.tick": ("Tick",),
    "mpc.problem.build": ("build_problem", "chosen_model"),
    "mpc.problem.constants": ("HARD_KINDS", "Problem"),
    "mpc.problem.formulas": ("term", "term_symbols"),
    "mpc.problem.terms": ("all_terms", "parameter_places"),
}
__getattr__, _ = on_first_use(__package__, {name: home for home, names in _NAMES.items() for name in names})


def require(version: int) -> None:
    """Raise MissingPackageError unless the sources have this version."""
    if version != VERSION:
        raise MissingPackageError(
            f"core sources: version {version} is needed, diffdrive-mpc has {VERSION}; install packages of one version"
        )
