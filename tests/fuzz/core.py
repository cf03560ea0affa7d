"""The C core with sanitizers: drives of `ControllerFuzzer`, backends with invalid results, and invalid sizes."""

from __future__ import annotations

import atexit
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import cffi
import numpy as np

from diffdrive_mpc.mpc import controller as product
from diffdrive_mpc.mpc.core import library
from diffdrive_mpc.mpc.core.sources import core_texts
from diffdrive_mpc.mpc.solver.backend import solve_all
from diffdrive_mpc.mpc.solver.report import SolverStatus
from fuzz import controller, odd
from fuzz.case import Case, FaultError

HERE = Path(__file__).parent
FLAGS = [
    *("-std=c99", "-D_POSIX_C_SOURCE=199309L", "-O1", "-fPIC", "-shared", "-Wall", "-Wextra", "-Werror"),
    *("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer"),
    *("-include", str(HERE / "fuzz_guard.h")),
]
SIZES = ({}, {"horizon": 1}, {"horizon": 200}, {"estimator.veer": [0.1, 0.05, 0.0], "horizon": 6})
"""Settings added to the drawn settings, in turn: minimum and maximum horizon, and five more slips."""
VALID_SIZES = [3, 2, 0, 1, 2, 4, 1, 0, 0, 5, 0, 0, 0, 0, 10, 0, 0, 0, 0, 38]
"""Sizes of a small controller, in the order of `ddmpc_sizes`."""
BOUNDED_SIZES = ("steps", "states", "delay_v", "delay_omega", "window", "soft")
"""Sizes with a fixed maximum."""


def build_core(folder: Path) -> Path:
    """Compile the core in `folder`; return the library."""
    for name, text in core_texts().items():
        (folder / name).write_text(text)
    sources = map(str, sorted(folder.glob("*.c")))
    subprocess.run(["gcc", *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(folder / "core.so")], check=True)
    return folder / "core.so"


def corrupt_solutions(random: Random) -> None:
    """Make backends return extreme numbers or a random status in half of their solutions."""

    def solve_and_corrupt(*arguments: Any) -> Any:
        solution, report = solve_all(*arguments)
        kind, plan, multipliers = random.randrange(6), np.array(solution.plan), np.array(solution.multipliers)
        for array in (plan, multipliers) if kind < 2 else ():
            array.flat[random.choices(range(array.size), k=random.choice((1, 3, array.size)))] = odd.number(random)
        status = random.choice([*SolverStatus]) if kind in (1, 2) else report.status
        return solution._replace(plan=plan, multipliers=multipliers), replace(report, status=status)

    patch.object(product, "solve_all", solve_and_corrupt).start()


class CoreFuzzer:
    """Fuzzer of the sanitized core in a separate process: memory and commands must stay within their bounds."""

    name, time_limit, count, is_reducible = "core", 300.0, 1, False

    def draw(self, random: Random) -> Case:
        """Draw the seed and the number of drives."""
        return [random.randrange(2**31), 30]

    def check(self, case: Case) -> None:
        """Run the drives in a separate process, which ends with an error after a fault."""
        drive(_compiled_core(), *case)


def drive(core: Path, seed: int, count: int) -> int:
    """Run `count` cases of `seed` with the compiled core; return the number of steps, or raise FaultError."""
    asan = subprocess.run(["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True).stdout
    # With Python's own allocator, the sanitizer does not know the ends of small arrays.
    settings = {"LD_PRELOAD": asan.strip(), "PYTHONMALLOC": "malloc", "ASAN_OPTIONS": "detect_leaks=0"}
    settings |= {"UBSAN_OPTIONS": "print_stacktrace=1:abort_on_error=1", "PYTHONFAULTHANDLER": "1"}
    settings["PYTHONPATH"] = os.pathsep.join(sys.path)
    arguments = [sys.executable, "-m", "fuzz.core", str(core), str(seed), str(count)]
    options: dict[str, Any] = {"capture_output": True, "text": True, "env": os.environ | settings}
    process = subprocess.run(arguments, check=False, preexec_fn=_remove_memory_limit, **options)
    if process.returncode:
        raise FaultError(f"core: case {re.split('^case ', process.stderr, flags=re.MULTILINE)[-1][:2000]}")
    return int(process.stdout)


def _remove_memory_limit() -> None:
    """Remove the memory limit of the runner, because the sanitizer needs more addresses."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


@cache
def _compiled_core() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fuzz-core-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return build_core(folder)


def check_sizes() -> None:
    """Raise FaultError if the core accepts a size below zero or beyond its maximum."""
    ffi, lib = library.load_core()
    assert lib.ddmpc_reals(ffi.new("ddmpc_sizes *", VALID_SIZES))
    for name, _ in ffi.typeof("ddmpc_sizes").fields[:11]:
        for size in (-1, -(2**31), 100_000)[: 3 if name in BOUNDED_SIZES else 2]:
            sizes = ffi.new("ddmpc_sizes *", VALID_SIZES)
            setattr(sizes, name, size)
            if lib.ddmpc_reals(sizes) or lib.ddmpc_init(ffi.NULL, sizes, *[ffi.NULL] * 5):
                raise FaultError(f"sizes: accepts {name} = {size}")


def main(core: str, seed: str, count: str) -> None:
    """Run the cases in this process."""
    from diffdrive_mpc.mpc.core.tick import ResultLayout

    random = Random()

    def load_library(_: str, declarations: str, *options: object) -> tuple[cffi.FFI, Any]:
        ffi = cffi.FFI()
        ffi.cdef(declarations)
        return ffi, ffi.dlopen(core)

    def copy_arrays(layout: Any) -> Any:
        """Copy each array; the gaps between the arrays must not be read."""
        block = np.zeros_like(layout.live)
        for rows, _ in layout.slices.values():
            block[rows] = layout.live[rows]
        return block

    patch.object(library, "load_library", load_library).start()
    patch.object(ResultLayout, "copy", copy_arrays).start()
    patch.object(controller, "_ITERATION", math.inf).start()
    corrupt_solutions(random)
    check_sizes()
    warnings.simplefilter("ignore")
    fuzzer = controller.ControllerFuzzer()
    for index in range(int(count)):
        random.seed(f"core/{seed}/{index}")
        case = fuzzer.draw(random)
        case["overrides"] |= SIZES[index % len(SIZES)]
        print(f"case {index} of seed {seed}", file=sys.stderr, flush=True)
        fuzzer.check(case)
    print(fuzzer.steps)


if __name__ == "__main__":
    main(*sys.argv[1:])
