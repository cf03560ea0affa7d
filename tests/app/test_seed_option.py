"""How many seeds, and which."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import MOST_SEEDS, parse_seeds


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("3", (0, 1, 2)), ("7,", (7,)), ("3,4", (3, 4)), ("1000000000,", (1_000_000_000,))],
)
def test_a_number_or_a_list(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


def test_the_most_seeds_are_accepted_and_one_more_is_not() -> None:
    assert parse_seeds(str(MOST_SEEDS)) == tuple(range(MOST_SEEDS))
    with pytest.raises(ValueError, match=f"at most {MOST_SEEDS}"):
        parse_seeds(str(MOST_SEEDS + 1))


def test_more_seeds_than_memory_holds_are_one_line_of_error(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["bench", "--out", str(out), "--seeds", "1000000000"])
    assert result.exit_code == 2
    assert result.stderr.startswith("error: --seeds 1000000000: give at most 10000 seeds")
    assert result.stderr.count("\n") == 1
    assert not out.exists()
