"""The search that tunes the peers: it finds a known minimum, keeps to its budget and its ranges, and repeats itself."""

from __future__ import annotations

import numpy as np
import pytest

from diffdrive_mpc.bench.peers.tracking_peer import law_kind, load_gains
from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.peers.study import TUNED, GainSearch, PeersStudy, load_settings

RANGES = {"a": (0.1, 10.0), "b": (1.0, 1000.0)}


def found(evaluations: int) -> GainSearch:
    search = GainSearch(
        lambda values: np.log(values["a"] / 3.0) ** 2 + np.log(values["b"] / 2000.0) ** 2, RANGES, evaluations
    )
    search.scan(8, 0)
    search.refine(1.5)
    return search


def test_it_finds_the_minimum_inside_the_ranges() -> None:
    values, _ = found(80).best
    assert values["a"] == pytest.approx(3.0, rel=0.03)
    assert values["b"] == pytest.approx(1000.0)


@pytest.mark.parametrize("evaluations", [8, 20])
def test_it_keeps_to_its_budget_and_repeats_itself(evaluations: int) -> None:
    tried = found(evaluations).tried
    assert len(tried) == evaluations
    assert tried == found(evaluations).tried
    assert all(low <= values[name] <= high for values, _ in tried for name, (low, high) in RANGES.items())


@pytest.mark.parametrize("peer", TUNED)
def test_every_gain_of_every_peer_is_tuned(peer: str) -> None:
    settings = load_settings()
    assert set(settings.ranges[peer.partition("+")[0]]) == set(law_kind(peer).gains.model_fields)
    assert load_gains(peer).lead > 0.0
    assert peer in PeersStudy(settings).plan()


def test_an_unknown_peer_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown peer 'kanayma'"):
        PeersStudy(load_settings(), ["kanayma"]).plan()
