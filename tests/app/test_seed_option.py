"""How many seeds, and which."""

from __future__ import annotations

import pytest

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
