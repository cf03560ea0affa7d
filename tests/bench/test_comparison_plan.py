"""Which cases an experiment consists of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from bench_parts import quick_case

from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.bench.case import DIMENSIONS, label
from diffdrive_mpc.bench.comparison.plan import (
    ComparisonSettings,
    default_settings,
    plan_cases,
    read_options,
)

QUICK = {
    "controllers": ("mpc",),
    "models": ("ssm",),
    "plants": ("model:ssm",),
    "surfaces": ("ideal",),
    "sensors": ("perfect",),
    "beyond": False,
    "osqp": False,
}


def experiment(**changes: object) -> ComparisonSettings:
    return default_settings().model_copy(update={**QUICK, **changes})


def asked(**given: Any) -> ComparisonSettings:
    """What the options ask for, dimensions by their names in the plural."""
    values = {one.several: given.pop(one.several) for one in DIMENSIONS if one.several in given}
    return read_options(values, **given)


def test_the_default_is_a_peer_and_four_models_on_four_trajectories_with_five_seeds_and_no_sweep() -> None:
    chosen = asked()
    assert chosen == default_settings()
    assert chosen.controllers == ("pursuit+slip", "mpc")
    assert set(chosen.models) == {"kinematic", "mbm", "sm", "ssm"}
    assert set(chosen.trajectories) == {"circle", "square", "s", "cane"}
    assert len(chosen.seeds) == 5
    assert chosen.horizons == () and not chosen.beyond
    swept = asked(sweeps=True)
    assert swept.horizons == (5, 10, 20, 30, 50) and swept.beyond
    assert asked(sweeps=True, horizons="7").horizons == (7,)


@pytest.mark.parametrize(
    "given", [{"quick": True}, {"scaled": True}, {"settings": ["weights.across=1"]}, {"plants": "model:ssm"}]
)
def test_sweeps_stand_alone(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="--sweeps: beside it give"):
        asked(sweeps=True, **given)


def test_a_horizon_case_that_is_a_main_case_runs_once() -> None:
    plan = plan_cases(experiment(seeds=(0, 1), horizons=(5, 30)))
    assert load_config("ssm").horizon == 30
    assert len(plan.main) == 8
    assert len(plan.horizon) == 8
    assert len(plan.all) == 12
    assert {case.horizon for case in plan.horizon} == {5, 30}
    assert {case.seed for case in plan.horizon} == {0}


def test_a_peer_has_no_model_and_no_settings() -> None:
    settings = ((("horizon", 5),), (("horizon", 10),))
    plan = plan_cases(
        experiment(controllers=("mpc", "kanayama"), trajectories=("s",), seeds=(0,), horizons=(), settings=settings)
    )
    assert [(case.controller, case.model, case.horizon) for case in plan.all] == [
        ("mpc", "ssm", 5),
        ("mpc", "ssm", 10),
        ("kanayama", "none", None),
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"controllers": ("foo",)}, "unknown controller"),
        ({"models": ("foo",)}, "unknown model"),
        ({"trajectories": ("foo",)}, "unknown trajectory"),
        ({"plants": ("foo",)}, "unknown plant"),
        ({"sensors": ("foo",)}, "unknown sensor"),
        ({"scenarios": ("none", "foo")}, "unknown scenario"),
        ({"settings": ((("horizn", 5),),)}, "did you mean 'horizon'"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_runs(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        plan_cases(experiment(horizons=(), seeds=(0,), **change))


SHIPPED = {
    "models": "models/parameters/ssm.yaml",
    "trajectories": "mpc/trajectories/built_in/s.yaml",
    "surfaces": "sim/plants/surfaces/ideal.yaml",
    "sensors": "sim/sensing/sensor_sets/perfect.yaml",
    "plants": "models/parameters/ssm.yaml",
    "scenarios": "sim/disturbances/scenarios/start_offset.yaml",
}


@pytest.mark.parametrize("dimension", SHIPPED)
def test_two_files_with_one_label_are_refused(dimension: str, tmp_path: Path) -> None:
    paths = [tmp_path / "a" / "mine.yaml", tmp_path / "b" / "Mine.yaml", tmp_path / "b" / "other.yaml"]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_text((Path(__file__).parents[2] / SHIPPED[dimension]).read_text())
    first, second, other = (f"model:{path}" if dimension == "plants" else str(path) for path in paths)
    changes = {"horizons": (), "seeds": (0,), "trajectories": ("s",)}
    with pytest.raises(ConfigError, match="rename one file") as refused:
        plan_cases(experiment(**{**changes, dimension: (first, second)}))
    assert f"{dimension}: '{first}' and '{second}'" in str(refused.value)
    assert len(plan_cases(experiment(**{**changes, dimension: (first, other)})).all) == 2


def test_a_file_with_the_label_of_a_shipped_model_or_a_peer_is_refused(tmp_path: Path) -> None:
    for name in ("SSM", "kanayama"):
        path = tmp_path / f"{name}.yaml"
        path.write_text((Path(__file__).parents[2] / SHIPPED["models"]).read_text())
        changes = {"models": ("ssm", str(path)), "controllers": ("mpc", "kanayama")}
        with pytest.raises(ConfigError, match=f"and '{path}' would both be '{name}'"):
            plan_cases(experiment(horizons=(), seeds=(0,), **changes))


@pytest.mark.parametrize(
    "given", [{"models": "nope"}, {"config": Path("nope.yaml")}, {"horizons": "5"}, {"settings": ["horizon=5"]}]
)
def test_peers_alone_refuse_what_they_would_ignore(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="the controller 'kanayama' takes no --models, --config, --set or --horizons"):
        asked(controllers="kanayama", **given)


def test_peers_alone_sweep_no_horizon() -> None:
    assert asked(controllers="kanayama", sweeps=True).horizons == ()
    assert asked(controllers="mpc,kanayama", models="ssm", sweeps=True).horizons


def test_options_change_the_experiment() -> None:
    chosen = asked(models="ssm", seeds="3,4", surfaces="default,slippery", horizons="5,10")
    assert chosen.models == ("ssm",)
    assert chosen.seeds == (3, 4)
    assert chosen.surfaces == ("default", "slippery")
    assert chosen.horizons == (5, 10)


def test_scenarios_are_a_dimension_of_the_comparison_and_sweep_no_horizon_unless_asked() -> None:
    chosen = asked(scenarios="none,start_offset", models="ssm", trajectories="s", seeds="2")
    assert chosen.horizons == ()
    plan = plan_cases(experiment(scenarios=chosen.scenarios, trajectories=("s",), seeds=(0, 1), horizons=()))
    assert [(case.scenario, case.seed) for case in plan.all] == [
        ("none", 0),
        ("none", 1),
        ("start_offset", 0),
        ("start_offset", 1),
    ]
    assert asked(scenarios="push", horizons="5").horizons == (5,)


def test_quick_is_one_seed_without_horizons() -> None:
    chosen = asked(quick=True)
    assert chosen.seeds == (0,)
    assert chosen.horizons == ()
    assert asked(quick=True, seeds="2", horizons="5").seeds == (0, 1)


def test_a_sweep_has_no_horizon_table_unless_it_is_asked_for() -> None:
    assert asked(settings=["weights.across=1,2"]).horizons == ()
    assert asked(settings=["weights.across=1,2"], horizons="5").horizons == (5,)
    assert asked(horizons="none").horizons == ()
    with pytest.raises(ConfigError, match="give one of them"):
        asked(settings=["horizon=5"], horizons="5")


def test_a_configuration_file_brings_its_model(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("model: ssm\nhorizon: 12\n")
    chosen = asked(config=path)
    assert chosen.models == ("ssm",)
    plan = plan_cases(experiment(config=str(path), horizons=(), trajectories=("s",), seeds=(0,)))
    assert plan.all[0].horizon == 12


def test_a_model_file_of_the_users_own_is_named_by_its_stem(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "models" / "parameters" / "ssm.yaml"
    path = tmp_path / "my_robot.yaml"
    path.write_text(source.read_text())
    case = quick_case(model=str(path), plant=f"model:{path}")
    assert case.labels["model"] == "my_robot"
    assert case.labels["plant"] == "model:my_robot"
    assert case.horizon == load_config("ssm").horizon
    assert len(plan_cases(experiment(models=(str(path),), horizons=(), seeds=(0,))).all) == 4


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("ssm", "ssm"),
        ("folder/mine.yaml", "mine"),
        ("model:folder/mine.yaml+0.04", "model:mine+0.04"),
        ("model:sm+0.08", "model:sm+0.08"),
        ("drive.v2.csv", "drive.v2"),
    ],
)
def test_labels_tell_names_apart_without_folders(name: str, shown: str) -> None:
    assert label(name) == shown
