"""The compiled core and compiled functions of the user, loaded through cffi.

The core is the package's own where a wheel brought one. Else it is compiled at first use for the processor at hand, and
kept in the user's cache (`models/compiled/cache.py`). Its declarations are the text of its header, so names cross the
border by name.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import cffi

from diffdrive_mpc.models.compiled.cache import load_cached
from diffdrive_mpc.models.compiled.compiler import NATIVE, NotCompiledError, build_library, what_is_built
from diffdrive_mpc.models.compiled.packaged import load_library
from diffdrive_mpc.mpc.core.packaged import packaged_libraries
from diffdrive_mpc.mpc.core.sources import core_declarations, core_origin, library_texts, shared_headers

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.core.generate import GeneratedC

_FUNCTION = "int {name}(const real **, real **, long long *, real *, int);"


@cache
def load_core() -> tuple[cffi.FFI, Any]:
    """The core: cffi's declarations of `mpc/core/core.h`, and the library.

    Raises
    ------
    NotCompiledError
        If the package brought no library, and none can be compiled.
    """

    def build(folder: Path) -> Path:
        return build_library(library_texts(), folder, NATIVE)

    made_of = {"core": core_origin(), "casadi": ca.CasadiMeta.version()}
    complaint = "the controller's core is not compiled: {}, which holds the core"
    return load_library("ddmpc_core", core_declarations(), packaged_libraries(), made_of, build, complaint)


@cache
def load_functions(generated: GeneratedC) -> Any:  # noqa: ANN401 - cffi has no type for a library
    """The library of generated functions, each to be had by its name, with the core's types.

    Raises
    ------
    NotCompiledError
        If they cannot be compiled: functions of the user need a C compiler.
    """
    ffi, _ = load_core()
    ffi.cdef("\n".join(_FUNCTION.format(name=name) for name in generated.names), override=True)
    texts = shared_headers() | {f"{generated.stem}.c": generated.source, f"{generated.stem}.h": generated.header}

    def build(folder: Path) -> Path:
        return build_library(texts, folder, NATIVE)

    try:
        return load_cached(generated.stem, what_is_built(texts), build, lambda path: ffi.dlopen(str(path)))
    except NotCompiledError as error:
        raise NotCompiledError(f"functions of the user are compiled, these are not: {error}; install gcc") from error
