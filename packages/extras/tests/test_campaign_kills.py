"""Killed workers, schedulers and campaigns change nothing: a short form of `campaign_kills.py`."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from campaign_kills import disturb, prepare


@pytest.mark.long
def test_results_are_those_of_an_undisturbed_campaign(tmp_path: Path) -> None:
    quiet, chance = prepare(tmp_path), random.Random(5)
    assert len(disturb(tmp_path, quiet, 1, chance, dask=True)) == 1
    assert len(disturb(tmp_path, quiet, 1, chance, dask=False)) == 1
