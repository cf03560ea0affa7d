"""Which runs the tracking study consists of."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from tracking_parts import TINY

from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.tracking.measured import BOUND
from studies.tracking.study import TrackingStudy, load_study

TUNING_SEEDS = {100, 101}
MODELS, TRAJECTORIES = ("mbm", "sm", "ssm"), ("circle", "square", "s", "cane")


def cases_of(study, only=()):
    return {name: [drive.case for drive in drives] for name, drives in study.drives(only).items()}


def every(parts):
    return list(dict.fromkeys(case for cases in parts.values() for case in cases))


@pytest.fixture(params=[False, True], ids=["whole", "quick"])
def study(request):
    return load_study(quick=request.param)


def test_no_seed_of_the_study_was_used_for_tuning(study):
    assert not {case.seed for case in every(cases_of(study))} & TUNING_SEEDS


def test_weights_limits_and_horizon_are_the_shipped_ones_everywhere(study):
    """Only the ablation changes anything, and only what compensates."""
    parts = cases_of(study)
    changed = {key for case in every(parts) for key, _ in case.overrides}
    assert {key.partition(".")[0] for key in changed} == {"compensation"}
    others = [case for name, cases in parts.items() if name != "ablation" for case in cases]
    assert not any(case.overrides or case.config for case in others)


def test_no_part_runs_a_case_twice_and_parts_share_cases(study):
    parts = cases_of(study)
    for cases in parts.values():
        assert len(set(cases)) == len(cases)
    assert len(every(parts)) < sum(map(len, parts.values()))


def test_what_was_asked_for_is_driven_by_every_model_along_every_trajectory_with_ten_seeds():
    targets = set(cases_of(load_study())["targets"])
    everything = itertools.product(MODELS, TRAJECTORIES, range(20, 30))
    places = {(case.surface, case.sensors, case.scenario) for case in targets}
    assert places == {
        ("default", "default", "none"),
        ("slippery", "default", "none"),
        ("grippy", "default", "none"),
        ("default", "slam", "none"),
        ("default", "default", "start_offset"),
        ("default", "default", "false_command"),
    }
    driven = {(c.model, c.trajectory, c.seed, (c.surface, c.sensors, c.scenario)) for c in targets}
    assert driven == {(*one, place) for one in everything for place in places}
    assert all(case.plant == "mujoco" for case in targets)


def test_the_ablation_leaves_out_each_part_alone_and_all_of_them():
    study = load_study()
    left_out = [tuple(key for key, value in one.items() if value is False) for one in study.variants.values()]
    four = tuple(f"compensation.{name}" for name in ("dead_time", "v_offset", "yaw_gain", "side_slip"))
    assert left_out == [(), *((one,) for one in four), four]
    assert len(cases_of(study, ["ablation"])["ablation"]) == 6 * 2 * 3 * 4 * 3


def test_the_cross_table_has_every_controller_on_every_model_as_plant():
    pairs = {(case.model, case.plant) for case in cases_of(load_study())["cross"]}
    assert pairs == set(itertools.product(MODELS, [f"model:{name}" for name in MODELS]))


def test_the_bound_has_perfect_sensors_and_every_surface_of_the_ablation(study):
    parts = cases_of(study)
    assert {(case.controller, case.sensors, case.plant) for case in parts["bound"]} == {(BOUND, "perfect", "mujoco")}
    assert {case.surface for case in parts["bound"]} == {case.surface for case in parts["ablation"]}


def test_an_unknown_part_is_refused():
    with pytest.raises(ConfigError, match=r"--only: unknown part 'crosses'; known: targets, ablation"):
        load_study().drives(["crosses"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("variant: [as shipped, no", "variant: [long sight, no", "there is no 'long sight'; known: as shipped"),
        ("parts:", "part:", "key 'parts' is missing"),
        ("model: [ssm]", "model: []", "vary.model: Tuple should have at least 1 item"),
        (
            "compensation.side_slip: false",
            "compensation.side_slop: false",
            "unknown key 'expert.compensation.side_slop'",
        ),
        ("sensors: [slam]", "sensors: [slum]", "unknown sensor set 'slum'"),
        ("trajectory: [cane]", "trajectory: [can]", "can"),
        ('"model:sm"', '"model:foo"', "unknown model 'foo'"),
    ],
)
def test_a_mistake_in_a_study_is_one_line_before_anything_is_driven(old: str, new: str, message: str, tmp_path: Path):
    assert old in TINY
    (tmp_path / "mine.yaml").write_text(TINY.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message) as error:
        TrackingStudy(load_study(tmp_path / "mine.yaml")).plan()
    assert "\n" not in str(error.value)
