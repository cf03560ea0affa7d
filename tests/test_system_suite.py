"""Partial test runs end with the number of skipped tests and their needs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[1]


def run_pytest(*words, **environment):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_system_suite_without_its_programs_fails_with_one_line_that_names_the_packages(tmp_path):
    done = run_pytest("-m", "system", PATH=str(tmp_path), HOME=str(tmp_path))
    assert done.returncode != 0
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("ERROR: the system suite cannot run: not installed: chromium, firefox-esr, ")
    assert " on Debian or Ubuntu: sudo apt-get install chromium firefox-esr " in line


def test_run_without_the_system_suite_ends_with_its_size(tmp_path):
    """Tested in the process of pytest, and with a worker of xdist."""
    for workers in ("0", "1"):
        words = ("-n", workers, "-m", "not system", "tests/studies/test_declared_tables.py")
        done = run_pytest(*words, PATH=str(tmp_path), HOME=str(tmp_path))
        assert done.returncode == 0, done.stdout
        last = done.stdout.rstrip().splitlines()[-1]
        assert last.startswith("1 more tests need processes, many drives or Debian packages (")
        assert last.endswith("): make test-system")


@pytest.mark.parametrize("workers", ["0", "1"])
def test_run_without_real_logs_ends_with_their_number_and_source(workers):
    environment = {name: value for name, value in os.environ.items() if name != "DIFFDRIVE_MPC_DATA"}
    done = run_pytest("-n", workers, "tests/models/test_logs_real.py", **environment)
    assert done.returncode == 0, done.stdout
    assert done.stdout.rstrip().splitlines()[-1] == (
        "18 more tests need real logs: set DIFFDRIVE_MPC_DATA to a folder with norlab_husky_tile/ and "
        "norlab_warthog_terrains/ (NORLAB, BSD-3-Clause; see CONTRIBUTING.md)"
    )
