"""Partial test runs end with the number of skipped tests and their needs."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[1]


def run_pytest(*arguments, **environment):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_system_suite_without_its_programs_fails_with_one_line_that_names_the_packages(tmp_path):
    result = run_pytest("-m", "system", PATH=str(tmp_path), HOME=str(tmp_path))
    assert result.returncode != 0
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("ERROR: the system suite cannot run: not installed: chromium, firefox-esr, ")
    assert " on Debian or Ubuntu: sudo apt-get install chromium firefox-esr " in line
