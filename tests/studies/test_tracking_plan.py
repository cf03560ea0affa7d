"""Which runs the tracking study consists of."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from tracking_parts import TINY

from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.tracking.plan import BOUND, check_plan, plan_study, variants
from studies.tracking.settings import PARTS, load_study

TUNING_SEEDS = {100, 101}
MODELS, TRAJECTORIES = ("mbm", "sm", "ssm"), ("circle", "square", "s", "cane")


@pytest.fixture(params=[False, True], ids=["whole", "quick"])
def study(request):
    return load_study(quick=request.param)


def test_no_seed_of_the_study_was_used_for_tuning(study):
    assert not {case.seed for case in plan_study(study).all} & TUNING_SEEDS


def test_weights_limits_and_horizon_are_the_shipped_ones_everywhere(study):
    """Only the ablation changes anything, and only what compensates."""
    plan = plan_study(study)
    changed = {key for case in plan.all for key, _ in case.overrides}
    assert {key.partition(".")[0] for key in changed} == {"compensation"}
    others = [case for name in PARTS if name != "ablation" for case in plan.parts[name]]
    assert not any(case.overrides or case.config for case in others)


def test_no_part_runs_a_case_twice_and_parts_share_cases(study):
    plan = plan_study(study)
    for cases in plan.parts.values():
        assert len(set(cases)) == len(cases)
    assert len(plan.all) < sum(map(len, plan.parts.values()))


def test_what_was_asked_for_is_driven_by_every_model_along_every_trajectory_with_ten_seeds():
    targets = set(plan_study(load_study(), ["targets"]).all)
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
    left_out = [tuple(key for key, value in overrides if value is False) for overrides in variants(study)]
    four = tuple(f"compensation.{name}" for name in ("dead_time", "v_offset", "yaw_gain", "side_slip"))
    assert left_out == [(), *((one,) for one in four), four]
    assert len(plan_study(study, ["ablation"]).all) == 6 * 2 * 3 * 4 * 3


def test_the_cross_table_has_every_controller_on_every_model_as_plant():
    cases = plan_study(load_study(), ["cross"]).all
    pairs = {(case.model, case.plant) for case in cases}
    assert pairs == set(itertools.product(MODELS, [f"model:{name}" for name in MODELS]))


def test_the_bound_has_perfect_sensors_and_every_surface(study):
    cases = plan_study(study, ["bound"]).all
    assert {(case.controller, case.sensors, case.plant) for case in cases} == {(BOUND, "perfect", "mujoco")}
    assert {case.surface for case in cases} == set(study.bound.surfaces)


def test_an_unknown_part_is_refused():
    with pytest.raises(ConfigError, match=r"--only: unknown part 'crosses'; known: targets, ablation"):
        plan_study(load_study(), ["crosses"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds: [20, 21]", "seeds: [20]", "ablation.seeds: Tuple should have at least 2 items"),
        ("drawn: [no side-slip", "drawn: [long sight", "there is no variant 'long sight'"),
        ("bound:", "bounds:", "key 'bound' is missing"),
        ("models: [ssm]\n", "models: []\n", "models: Tuple should have at least 1 item"),
    ],
)
def test_a_mistake_in_a_study_is_one_line(old: str, new: str, message: str, tmp_path: Path):
    (tmp_path / "mine.yaml").write_text(TINY.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message) as error:
        load_study(tmp_path / "mine.yaml")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("compensation.side_slip: false", "compensation.side_slop: false", "unknown key 'compensation.side_slop'"),
        ("late_sensors: slam", "late_sensors: slum", "unknown sensor set 'slum'"),
        ("trajectories: [cane]", "trajectories: [can]", "can"),
        ("plants: [sm, ssm]", "plants: [foo]", "unknown model 'foo'"),
    ],
)
def test_what_does_not_exist_is_found_before_anything_runs(old: str, new: str, message: str, tmp_path: Path):
    (tmp_path / "mine.yaml").write_text(TINY.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message):
        check_plan(plan_study(load_study(tmp_path / "mine.yaml")))
