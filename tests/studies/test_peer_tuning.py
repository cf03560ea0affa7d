"""The search that tunes the peers: it finds a known minimum, keeps its budget and ranges, and is reproducible."""

import numpy as np
import pytest

from studies.peers.study import GainSearch

RANGES = {"a": (0.1, 10.0), "b": (1.0, 1000.0)}


def run_search(evaluations: int) -> GainSearch:
    search = GainSearch(
        lambda values: np.log(values["a"] / 3.0) ** 2 + np.log(values["b"] / 2000.0) ** 2, RANGES, evaluations
    )
    search.scan(8, 0)
    search.refine(1.5)
    return search


def test_search_finds_the_minimum_inside_the_ranges() -> None:
    values, _ = run_search(80).best
    assert values["a"] == pytest.approx(3.0, rel=0.03)
    assert values["b"] == pytest.approx(1000.0)


@pytest.mark.parametrize("evaluations", [8, 20])
def test_search_keeps_its_budget_and_is_reproducible(evaluations: int) -> None:
    trials = run_search(evaluations).trials
    assert len(trials) == evaluations
    assert trials == run_search(evaluations).trials
    assert all(low <= values[name] <= high for values, _ in trials for name, (low, high) in RANGES.items())
