"""Ctrl-C and SIGTERM end a command with one line and the exit code that shells expect, and leave nothing behind."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

from commands import invoke
from diffdrive_mpc.app.cli import app


@pytest.mark.parametrize("kind", [KeyboardInterrupt, typer.Abort])
def test_an_interrupted_command_says_so(kind: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise kind

    monkeypatch.setattr("diffdrive_mpc.app.model_report.print_model", interrupted)
    result = invoke(app, "models", "show", "ssm", code=130)
    assert result.stderr.strip() == "error: aborted"
    assert result.stdout == ""


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_sigterm_leaves_no_draft_and_no_process_behind(jobs: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()", "bench", "--seeds", "20"]
    words = ["--models", "ssm,sm", "--trajectories", "circle,s", "--jobs", jobs, "--out", str(tmp_path / "out")]
    with subprocess.Popen([*command, *words], stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        session = process.pid
        while not list(tmp_path.rglob("*")):
            assert process.poll() is None
            time.sleep(0.05)
        time.sleep(2.0)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 143
    assert said.strip() == "error: ended by SIGTERM"
    assert not list(tmp_path.rglob("*"))
    for _ in range(100):  # what was killed takes a moment; idle processes would stay for two minutes
        if session not in sessions():
            return
        time.sleep(0.1)
    raise AssertionError("processes are left")


def sessions() -> list[int]:
    """The session of each process."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            found.append(int(stat.read_text().rpartition(")")[2].split()[3]))
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found
