"""Hostile files of every kind are read, or refused with one line, within bounds; see `hostile_files`."""

from dataclasses import replace

import pytest

from fuzz.hostile_files import Outcome, run


@pytest.mark.parametrize(("seed", "count"), [(51, 20), pytest.param(52, 300, marks=pytest.mark.long)])
def test_hostile_files_are_read_or_refused_within_bounds(seed, count):
    outcomes = run(seed, count)
    assert not {outcome.name: outcome.faults() for outcome in outcomes if outcome.faults()}
    assert len(outcomes) == count


SOUND = Outcome("log: x", "read", 1.0, 100.0, 0.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"end": "refused: a line"}, ""),
        ({"end": "refused: a\x1b[2J"}, "cannot be shown"),
        ({"end": "killed by signal 9"}, "killed"),
        ({"end": "TypeError: x"}, "TypeError"),
        ({"seconds": 6.0}, "processor time"),
        ({"memory": 1100.0}, "memory"),
        ({"temporary": 70.0}, "temporary space"),
    ],
)
def test_broken_bound_is_a_fault(changes, words):
    faults = "; ".join(replace(SOUND, **changes).faults())
    assert bool(faults) == bool(words)
    assert words in faults
