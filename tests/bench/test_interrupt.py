"""Ctrl-C ends a command with one line and the exit code that shells expect."""

from __future__ import annotations

import pytest
import typer
from typer.testing import CliRunner

from diffdrive_mpc.bench.cli import app


@pytest.mark.parametrize("kind", [KeyboardInterrupt, typer.Abort])
def test_an_interrupted_command_says_so(kind: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise kind

    monkeypatch.setattr("diffdrive_mpc.bench.model_report.print_model", interrupted)
    result = CliRunner().invoke(app, ["models", "show", "ssm"])
    assert result.exit_code == 130
    assert result.stderr.strip() == "error: aborted"
    assert result.stdout == ""
