"""Tables and texts on the terminal keep to the width of COLUMNS, and lose nothing."""

from __future__ import annotations

import re

import pytest
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.table import Table

WIDE = Table(
    "Errors of everything that was driven, with a title that is long, too",
    ("controller", "trajectory", *(f"position {i} [m]" for i in range(12))),
    (
        ("mpc", "a_long_name_without_spaces", *(f"{100 + i}.{i:04d}" for i in range(12))),
        ("pursuit+slip", "circle", *(f"{200 + i}.{i:04d}" for i in range(12))),
    ),
    text_columns=2,
    note="A note that is longer than the terminal is wide, and so has to continue on the next line below the table.",
)
SENTENCES = Table("", ("key", "meaning"), (("first", "word " * 40 + "end"), ("x" * 90, "short")), text_columns=2)


def printed(table: Table, capsys: pytest.CaptureFixture[str]) -> str:
    output_console().print(table.rich())
    return capsys.readouterr().out


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_a_table_keeps_to_columns_and_no_cell_is_lost(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    for table in (WIDE, SENTENCES):
        text = printed(table, capsys)
        assert max(map(len, text.splitlines())) <= width
        assert "…" not in text
    numbers = re.findall(r"\d+\.\d+", printed(WIDE, capsys))
    assert sorted(numbers) == sorted(cell for row in WIDE.rows for cell in row[2:])
    assert printed(SENTENCES, capsys).split().count("word") == 40
    assert printed(SENTENCES, capsys).count("x") == 90


def test_columns_that_do_not_fit_continue_below_with_the_names(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = printed(WIDE, capsys)
    parts = text.count("pursuit+slip")
    assert parts > 1
    assert text.count("Errors of everything") == text.count("A note") == 1
    monkeypatch.setenv("COLUMNS", "200")
    assert printed(WIDE, capsys).count("pursuit+slip") == 1


def test_a_pipe_without_columns_is_wide(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert output_console().width == 140


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize(
    "words",
    [
        ("models", "list"),
        ("models", "show", "mbm"),
        ("models", "show", "lstm"),
        ("config", "schema"),
        ("schema",),
    ],
)
def test_commands_keep_to_columns(width: int, words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, list(words), env={"COLUMNS": str(width)})
    assert result.exit_code == 0, result.stderr
    assert max(map(len, result.stdout.splitlines())) <= width
