"""The study of narrow places: its plan, its oracle of stops, its peers that see."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from studies.worlds.settings import cases, load_settings
from studies.worlds.study import WorldsStudy

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.study import carry_out
from diffdrive_mpc_extras.worlds.plug_in import split


def is_through(case: Case) -> bool:
    return split(case.plant)[1].endswith(":through")


def test_every_controller_gets_the_same_worlds() -> None:
    settings = load_settings()
    for part, count in (("drawn", 12), ("crossing", 12), ("doorway", 12), ("named", 12)):
        found = cases(settings, part, ("mpc", "rpp+stop"), "sm", 12)
        if part not in settings.peers_in:
            assert len(found) == count and {one.controller for one in found} == {"mpc"}
            continue
        assert len(found) == 2 * count
        for ours, theirs in zip(found[::2], found[1::2], strict=True):
            assert (ours.controller, ours.model, theirs.model) == ("mpc", "sm", "none")
            assert (ours.seed, ours.plant, ours.surface, ours.sensors) == (
                theirs.seed,
                theirs.plant,
                theirs.surface,
                theirs.sensors,
            )
    assert len(cases(settings, "doorway", ("mpc",), "sm", None)) == 100
    drawn = cases(settings, "drawn", ("mpc",), "sm", None)
    assert len(drawn) == 1000 and sum(is_through(one) for one in drawn) == 500
    # Both kinds of worlds under each condition.
    places = {(split(one.plant)[2], one.surface, one.sensors, is_through(one)) for one in drawn}
    assert len(places) == 2 * len(settings.conditions)


@pytest.mark.long
def test_the_study_writes_what_it_drove(tmp_path: Path) -> None:
    runs = {"crossing": 1, "doorway": 1}
    study = WorldsStudy(load_settings(), ("crossing", "doorway"), controllers=("rpp+stop",), model="ssm", runs=runs)
    rows = carry_out(study, tmp_path / "out", jobs=1)
    assert list(rows["part"]) == ["crossing", "doorway"]
    found = json.loads((tmp_path / "out" / "worlds.json").read_text(encoding="utf-8"))
    assert [one["world"] for one in found["runs"]] == ["crossing", "doorway"]
    text = (tmp_path / "out" / "worlds.md").read_text(encoding="utf-8")
    assert "A person crosses" in text and "Named worlds" in text
