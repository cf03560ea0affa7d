"""The whole core with whatever may happen, at its smallest and its largest sizes, under AddressSanitizer and
UndefinedBehaviorSanitizer: see `fuzz_core.c`."""

import subprocess
from pathlib import Path

import pytest

from diffdrive_mpc.mpc.core.sources import core_texts

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


@pytest.fixture(scope="module")
def fuzz_core(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    for name, text in core_texts().items():
        (folder / name).write_text(text)
    sources = [*map(str, sorted(folder.glob("*.c"))), str(HERE / "fuzz_core.c")]
    subprocess.run(["gcc", *FLAGS, f"-I{folder}", *sources, "-lm", "-o", str(folder / "fuzz_core")], check=True)
    return folder / "fuzz_core"


@pytest.mark.parametrize("seed", range(1))
def test_nothing_out_of_bounds_and_no_command_out_of_limits(fuzz_core, seed):
    done = subprocess.run([str(fuzz_core), str(seed)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    lines = {line.split("  ")[0]: line for line in done.stdout.splitlines()}
    # Sizes at their maxima drove, and each kind of ending was met.
    assert "largest, function" in lines
    endings = ("tracking", "reused", "braking", "stopped", "finished", "active set", "backend")
    assert all(f"{ending} 0" not in lines["usual"] for ending in endings)
