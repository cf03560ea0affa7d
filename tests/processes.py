"""Processes of tests: Python with given code, the command line without a package, and a check that a process runs."""

import subprocess
import sys
from pathlib import Path

BOUND = 120.0
"""Time limit for a process [s]."""


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a separate Python process."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=BOUND, check=False)


def run_command(*command: str, without: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command line as a program, as if the package `without` were not installed."""
    missing = f"sys.modules[{without!r}] = None; " if without else ""
    arguments = ["diffdrive-mpc", *command]
    return run_python(f"import sys; {missing}sys.argv = {arguments}; from diffdrive_mpc.app.cli import main; main()")


def is_running(pid: int) -> bool:
    """Return True if a process runs, that is, it has not ended or become a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
