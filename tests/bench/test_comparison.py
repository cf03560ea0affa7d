"""Cases of the comparison, and results other than the error tables."""

import numpy as np
import pytest
from bench_parts import quick_case
from pandas import DataFrame

from diffdrive_mpc import make_plant
from diffdrive_mpc.bench.case import COMPARED, Case
from diffdrive_mpc.bench.comparison.order import interval, rank_controllers
from diffdrive_mpc.bench.comparison.plan import (
    LATE_TICKS,
    OTHER_SEEDS,
    SPEEDS,
    ComparisonSettings,
    default_settings,
    plan_cases,
)
from diffdrive_mpc.bench.controllers import LatePlant, build
from diffdrive_mpc.bench.experiment import frame
from diffdrive_mpc.bench.run_row import RunOutcome, row_of
from file_kinds import KINDS


def settings_with(**changes: object) -> ComparisonSettings:
    return default_settings().model_copy(update=changes)


def test_peer_has_no_model_and_no_settings() -> None:
    settings = ((("horizon", 5),), (("horizon", 10),))
    changes = {"controllers": ("mpc", "kanayama"), "models": ("ssm",), "trajectories": ("s",), "seeds": (0,)}
    changes |= {"horizons": (), "settings": settings, "beyond": False, "osqp": False}
    cases = [(case.controller, case.model, case.horizon) for case in plan_cases(settings_with(**changes)).all]
    assert cases == [("mpc", "ssm", 5), ("mpc", "ssm", 10), ("kanayama", "none", None)]


def test_bench_compares_the_declared_pairs() -> None:
    plan = plan_cases(settings_with(trajectories=("s",), seeds=(0,), beyond=True))
    *main, by_osqp = plan.main
    assert [(case.controller, case.model) for case in main] == list(COMPARED)
    assert (by_osqp.model, dict(by_osqp.overrides)) == ("ssm", {"solver.method": "osqp"})
    assert {case.top_speed for case in plan.speed} == set(SPEEDS)
    assert {case.seed for case in plan.other_seeds} == set(OTHER_SEEDS)
    mpc = [case.late for case in plan.dead_time if case.model == "ssm"]
    peer = [case.late for case in plan.dead_time if case.controller == COMPARED[0][0]]
    assert mpc == list(LATE_TICKS)
    assert peer == [ticks for ticks in LATE_TICKS if ticks >= 0]
    assert not set(plan.sweep_cases) & set(plan.all)


def test_top_speed_changes_the_timing_but_not_the_path() -> None:
    (_, _, slow), (_, _, fast) = (build(quick_case(trajectory="s", top_speed=speed)) for speed in (0.5, 1.0))
    (_, _, shipped) = build(quick_case(trajectory="s"))
    times = np.linspace(0.0, 1.0, 400)
    references = [trajectory.sample(times * trajectory.duration) for trajectory in (shipped, slow, fast)]
    assert np.allclose(references[0].pose, references[1].pose)
    assert [np.abs(trajectory.twist[:, 0]).max() for trajectory in references] == pytest.approx(
        [0.5, 0.5, 1.0], rel=1e-2
    )
    assert references[2].arc_length[-1] == pytest.approx(references[0].arc_length[-1])
    assert references[2].pose[-1] == pytest.approx(references[0].pose[-1])


def test_late_plant_repeats_the_motion_after_its_delay() -> None:
    reference, inner = (make_plant("model:ssm", "ideal", "perfect") for _ in range(2))
    late_plant = LatePlant(inner, 3)
    for plant in (reference, late_plant):
        plant.reset([0.0, 0.0, 0.0])
    commands = np.random.default_rng(1).uniform(-0.5, 0.5, (60, 2))
    motion: list[list[np.ndarray]] = [[], []]
    for command in commands:
        for plant, poses in zip((reference, late_plant), motion, strict=True):
            plant.measure()
            plant.advance(command)
            poses.append(plant.true_pose)
    np.testing.assert_allclose(motion[1][3:], motion[0][:-3], atol=1e-12)
    assert late_plant.measure().sent == pytest.approx(tuple(commands[-1])), "the sent command, not the applied one"
    assert late_plant.time == reference.time


def scores(outcome: RunOutcome, **errors: list[float]) -> DataFrame:
    """Return results of controllers with these position RMSE [m], over two trajectories and enough seeds."""
    cases = [
        (Case(model=model, trajectory=("s", "cane")[i % 2], seed=i // 2), error)
        for model, values in errors.items()
        for i, error in enumerate(values)
    ]
    return frame(row_of(case, outcome.run) | {"position_rmse_m": error} for case, error in cases)


def test_order_states_which_controllers_differ_significantly(outcome: RunOutcome) -> None:
    """SM is always 1 mm worse than MBM; SSM is equally often better and worse than SM."""
    base = np.array([5e-3, 9e-3, 5.2e-3, 9.1e-3, 5.1e-3, 8.8e-3])
    difference = 4e-4 * np.array([1, -1, 2, 1, -1, -1])
    rows = scores(outcome, mbm=list(base), sm=list(base + 1e-3), ssm=list(base + 1e-3 + difference))
    ranking = rank_controllers(rows.assign(completed=False))
    assert ranking[2].behind == pytest.approx(interval(difference))
    assert [entry.name for entry in ranking] == ["MBM", "SM", "SSM"]
    assert ranking[1].behind == pytest.approx([1e-3, 1e-3])
    assert ranking[1].is_significant and not ranking[2].is_significant
    assert ranking[0].rmse == pytest.approx(base.mean())
    unknown = rows.assign(position_rmse_m=[np.nan, *rows["position_rmse_m"][1:]])
    assert [entry.name for entry in rank_controllers(unknown)] == ["SM", "SSM"]
    assert ranking[0].spread == pytest.approx(np.std(base.reshape(3, 2).mean(axis=1)))


def test_bootstrap_interval_covers_the_mean_and_is_reproducible() -> None:
    values = np.random.default_rng(3).normal(2.0, 1.0, 400)
    low, high = interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)
    assert np.array_equal(interval(values), (low, high))


def test_files_of_the_user_are_labelled_by_stem_or_folder(tmp_path):
    path = tmp_path / "my_robot.yaml"
    path.write_text(KINDS["model"].texts["ssm"])
    assert quick_case(model=str(path), plant=f"model:{path}").labels["model"] == "my_robot"
    assert quick_case(plant="model:my_robot/model.yaml+0.04").labels["plant"] == "model:my_robot+0.04"
