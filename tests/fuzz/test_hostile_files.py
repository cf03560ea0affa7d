"""Hostile files of every kind are read, or refused with one line, within bounds; see `hostile_files`."""

import time

import pytest

from fuzz.hostile_files import MAKERS, Outcome, Reading, examine, run


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


SOUND = Reading("read", 1.0, 1.0, 0.0, 100.0, 0.0)


@pytest.mark.parametrize(
    ("read", "interrupted", "words"),
    [
        (SOUND, None, ""),
        (SOUND, Reading("interrupted", 1.0, 1.0, 0.0, 100.0, 0.0, 0.5), ""),
        (SOUND._replace(end="refused: a\x1b[2J"), None, "cannot be shown"),
        (SOUND._replace(end="hangs"), None, "hangs"),
        (SOUND._replace(end="TypeError: x"), None, "TypeError"),
        (SOUND._replace(seconds=6.0), None, "processor time"),
        (SOUND._replace(wall=16.0), None, "wall time"),
        (SOUND._replace(wall=26.0, waited=20.0), None, ""),
        (SOUND._replace(memory=1100.0), None, "memory"),
        (SOUND._replace(temporary=70.0), None, "temporary space"),
        (SOUND, Reading("interrupted", 4.0, 4.0, 0.0, 100.0, 0.0, 3.0), "from Ctrl-C"),
    ],
)
def test_broken_bound_is_a_fault(read, interrupted, words):
    faults = "; ".join(Outcome("log: x", 0, read, interrupted).faults())
    assert bool(faults) == bool(words)
    assert words in faults


def work(seconds=2.0):
    # Processor time: waiting for a core does not count as time of a reader.
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def swallows(_):
    try:
        work()
    except KeyboardInterrupt:
        work(0.1)


def turns_into_an_error(_):
    try:
        work()
    except KeyboardInterrupt:
        raise ValueError("damaged") from None


def ends_late(_):
    try:
        work()
    except KeyboardInterrupt:
        work(2.5)
        raise


@pytest.mark.system
@pytest.mark.parametrize(
    ("reader", "words"),
    [
        (lambda _: work(), ""),
        (swallows, "Ctrl-C has no effect"),
        (turns_into_an_error, "Ctrl-C has no effect"),
        (ends_late, "from Ctrl-C"),
    ],
)
def test_reader_that_does_not_end_by_ctrl_c_is_a_fault(tmp_path, reader, words):
    outcome = examine(reader, tmp_path, tmp_path)
    assert outcome.interrupted is not None
    assert words in "; ".join(outcome.faults())
    assert bool(outcome.faults()) == bool(words)
