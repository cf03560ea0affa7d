"""The study of the front: energy falls as its weight grows, and the tables say at what price."""

import json

import pytest

from commands import invoke
from studies.cli import app
from studies.energy_front.study import HERE, FrontRun, fronts, load_study


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    out = tmp_path_factory.mktemp("front")
    invoke(app, "energy-front", "--quick", "--jobs", "1", "--out", out)
    return out


def test_energy_falls_and_the_error_grows_with_the_weight(report):
    runs = json.loads((report / "energy-front.json").read_text())["runs"]
    by_weight = {weight: [one for one in runs if one["weight"] == weight] for weight in (0.0, 0.005, 0.05)}
    for free, little, much in zip(*by_weight.values(), strict=True):
        assert free["seed"] == little["seed"] == much["seed"]
        assert free["completed"] and little["completed"] and much["completed"]
        assert free["energy"] > 1.02 * little["energy"] > 1.02 * much["energy"]
        assert little["error"] < 1.2 * free["error"] < 0.6 * much["error"]
    assert (report / "figures" / "front.png").stat().st_size > 10_000


def test_what_is_saved_is_paired_by_seed():
    """Seeds that take more energy anyway are held against themselves."""
    made = [
        FrontRun("floor", "path", weight, seed, energy, 0.01, 0.01, completed=weight < 1.0)
        for seed, used in enumerate((100.0, 200.0))
        for weight, energy in ((0.0, used), (0.5, 0.9 * used), (1.0, 0.8 * used))
    ]
    none, some, most = fronts(made)["floor", "path"]
    assert none.saved.value == 0.0
    assert (some.saved.value, some.saved.low, some.saved.high) == pytest.approx((0.1, 0.1, 0.1))
    assert (some.completed, most.completed, most.of) == (2, 0, 2)
    assert some.energy.value == pytest.approx(135.0)


def test_the_shipped_study_compares_at_least_eight_weights_on_two_floors_with_corners():
    asked = load_study()
    cases = asked.cases(HERE)
    assert len(asked.weights) >= 8 and min(asked.weights) == 0.0
    assert len({case.surface for case in cases}) == 2
    assert len(cases) == len({(case.surface, case.trajectory, case.overrides, case.seed) for case in cases}) == 270
