"""The C core under sanitizers: `fuzz_core.c`, whose seed is the case."""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from random import Random

from diffdrive_mpc.mpc.core.sources import core_texts
from fuzz.case import Case, FaultError

HERE = Path(__file__).parent
FLAGS = (
    "-std=c99",
    "-D_POSIX_C_SOURCE=199309L",
    "-O1",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
    "-include",
    str(HERE / "fuzz_guard.h"),
)


def build_core(folder: Path) -> Path:
    """Compile the core and its fuzzer in `folder`; returns the program."""
    for name, text in core_texts().items():
        (folder / name).write_text(text)
    sources = [*map(str, sorted(folder.glob("*.c"))), str(HERE / "fuzz_core.c")]
    subprocess.run(["gcc", *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(folder / "fuzz_core")], check=True)
    return folder / "fuzz_core"


@cache
def _built() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="fuzz-core-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return build_core(folder)


class CoreFuzzer:
    """Sizes, constants, clocks, targets and answers of any kind; no byte or command out of bounds."""

    name, longest, count, is_reducible = "core", 300.0, 1, False

    def draw(self, random: Random) -> Case:
        """Draw the seed of the program."""
        return random.randrange(2**31)

    def check(self, case: Case) -> None:
        """Run the program, which aborts on a fault; the sanitizer needs more addresses than the runner allows."""
        program = _built()
        done = subprocess.run(
            [str(program), str(case)],
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=_without_bounds,
            env=os.environ,
        )
        if done.returncode:
            raise FaultError(f"core: {done.stderr[-1500:]}")


def _without_bounds() -> None:
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
