"""Tables in a terminal of 80 columns."""

from io import StringIO

import pytest
from rich.console import Console

from diffdrive_mpc.bench.table import Table

NUMBERS = ("position RMSE [m]", "lateral RMSE [m]", "solve p50 [ms]", "solve p99 [ms]", "fallbacks", "completed")


@pytest.mark.parametrize("names", [1, 2])
def test_no_word_breaks_and_no_line_is_longer_than_the_terminal(names):
    columns = ("controller", "stand-in")[:names] + NUMBERS * 2
    row = ("p2_experimental", "model of held-out data")[:names] + ("0.0014",) * 12
    note = "Means over trajectories and seeds."
    console = Console(width=80, file=StringIO())
    console.print(Table("Summary", columns, (row,), names, note).rich())
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    words = " ".join(lines).split()
    assert words.count("0.0014") == 12 and {"p2_experimental", "controller", "fall-backs", *note.split()} <= set(words)
    assert note in lines
