"""The tables of docs/energy.md about logs are those that its command makes."""

import numpy as np

from studies.documents.energy_page import PAGE, learned_table, told


def numbers(row: str) -> list[float]:
    return [float(cell) for cell in row.strip("| ").split("|")[1:]]


def test_a_floor_s_row_is_the_one_of_the_page() -> None:
    (row,) = learned_table(("carpet",)).splitlines()[2:]
    between = (
        PAGE.read_text(encoding="utf-8").split("<!-- log-learned:begin -->")[1].split("<!-- log-learned:end -->")[0]
    )
    shown = next(line for line in between.splitlines() if line.startswith("| carpet |"))
    # Rounding apart, and what another processor's arithmetic may change.
    assert np.abs(np.subtract(numbers(row), numbers(shown))).max() < 0.3


def test_constants_are_found_within_what_is_stated() -> None:
    found = told("fsu_bot", "default", (21,), 2)
    assert found.off.shape == (2, 3) and found.refused == 0
    assert np.abs(found.normalised).max() < 4.0
    assert np.abs(found.off).max() < 0.3
