"""Hostile files of every kind are read, or refused with one line, within bounds; see `hostile_files`."""

import pytest

from fuzz.hostile_files import MAKERS, Outcome, run


def check(outcomes):
    faults = {f"{outcome.index} {outcome.name}": outcome.faults() for outcome in outcomes if outcome.faults()}
    assert not faults


def test_thirty_hostile_files_are_read_or_refused_within_bounds():
    check(run(seed=51, count=30))


@pytest.mark.long
def test_three_hundred_hostile_files_are_read_or_refused_within_bounds():
    outcomes = run(seed=52, count=300)
    check(outcomes)
    assert {outcome.name.partition(":")[0] for outcome in outcomes} == {name.partition(":")[0] for name in MAKERS}
    assert any(outcome.interrupted is not None for outcome in outcomes)


@pytest.mark.parametrize(
    ("end", "figures", "words"),
    [
        ("read", (1.0, 1.0, 100.0, 0.0, None), ""),
        ("refused: a\x1b[2J", (1.0, 1.0, 100.0, 0.0, None), "cannot be shown"),
        ("hangs", (1.0, 60.0, 100.0, 0.0, None), "hangs"),
        ("TypeError: x", (1.0, 1.0, 100.0, 0.0, None), "TypeError"),
        ("read", (6.0, 6.0, 100.0, 0.0, 0.1), "processor time"),
        ("read", (1.0, 1.0, 1100.0, 0.0, None), "memory"),
        ("read", (1.0, 1.0, 100.0, 70.0, None), "temporary space"),
        ("read", (4.0, 4.0, 100.0, 0.0, 3.0), "Ctrl-C"),
    ],
)
def test_broken_bound_is_a_fault(end, figures, words):
    faults = "; ".join(Outcome("log: x", 0, end, *figures).faults())
    assert bool(faults) == bool(words)
    assert words in faults
