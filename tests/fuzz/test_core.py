"""The whole core with whatever may happen, at its smallest and its largest sizes, under AddressSanitizer and
UndefinedBehaviorSanitizer: see `fuzz_core.c`."""

import subprocess

import pytest

from fuzz.core import build_core

# `make fuzz` drives as long as the fuzzer says.
SHORTER = "6"


@pytest.fixture(scope="module")
def fuzz_core(tmp_path_factory):
    return build_core(tmp_path_factory.mktemp("fuzz"))


@pytest.mark.parametrize("seed", range(1))
def test_nothing_out_of_bounds_and_no_command_out_of_limits(fuzz_core, seed):
    done = subprocess.run([str(fuzz_core), str(seed), SHORTER], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    lines = {line.split("  ")[0]: line for line in done.stdout.splitlines()}
    # Sizes at their maxima drove, and each kind of ending was met.
    assert "largest, function" in lines
    endings = ("tracking", "reused", "braking", "stopped", "finished", "active set", "backend")
    assert all(any(f"{ending} 0" not in line for line in lines.values()) for ending in endings)
