"""`diffdrive-mpc tune`: its command, its search, and its objective."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from opened_report import content_of
from tune_parts import searched, small_plan, written

from commands import call
from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.app.tune.objective import broken, exceeded, in_words, predicted_p99, score, terms_of
from diffdrive_mpc.app.tune.search import Searched, TunePoint
from diffdrive_mpc.app.tune.study import tune
from diffdrive_mpc.app.tune.tune_file import Constraint, Objective, StepTime, load_plan
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.statistics import BootstrapEstimate
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.campaign.check import check_definitions
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.engine import CampaignRun, drive_all


@pytest.fixture(scope="module")
def tuned_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[object, ...], str]:
    """The folder of a tuning, the words of its command, and what that printed."""
    folder = tmp_path_factory.mktemp("tuned")
    words = ("tune", "ssm", "--plan", written(folder), "--out", folder / "out", "--jobs", "1")
    return folder / "out", words, " ".join(call(*words).split())


def test_a_tuning_leaves_configuration_report_and_study(
    tuned_once: tuple[Path, tuple[object, ...], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, words, said = tuned_once
    report = (out / "tune.md").read_text(encoding="utf-8")
    for part in ("Verdict", "Chosen point", "What each parameter buys", "Error against effort"):
        assert f"## {part}\n" in report
    assert {path.name for path in (out / "figures").iterdir()} == {"front.png", "search.png"}
    found = json.loads((out / "tune.json").read_text(encoding="utf-8"))
    sentence = found["meta"]["sentence"]
    assert sentence in said
    assert f"* {sentence[0].upper()}{sentence[1:]}.\n" in report
    assert len(found["points"]) == 11
    page = content_of(out / "report.html")
    assert page["key_figures"][0]["value"] == ("yes" if found["meta"]["improved"] else "no")
    assert {"Error against effort", "How the search went"} <= {view["title"] for view in page["views"]}
    # The file drives, and differs from the defaults in what was tuned only, where the interval says that it is better.
    tuned, usual = load_config(out / "config.yaml"), load_config("ssm")
    assert found["meta"]["improved"] == (found["verdict"]["gain"]["low"] > 0.0)
    assert (tuned != usual) == found["meta"]["improved"]
    assert tuned.model_copy(update={"weights": usual.weights, "horizon": usual.horizon}) == usual
    text = (out / "config.yaml").read_text(encoding="utf-8")
    assert text.startswith(f"# Tuned from ssm: {sentence}.\n")
    assert ("# was " in text) == found["meta"]["improved"]
    # A repeated tuning drives nothing, and says the same.
    monkeypatch.setattr("diffdrive_mpc_extras.campaign.engine.drive", None)
    call(*words, "--points", 11)
    assert (out / "tune.md").read_text(encoding="utf-8").partition("## ")[2] == report.partition("## ")[2]
    assert (out / "config.yaml").read_text(encoding="utf-8") == text


def test_where_nothing_is_better_the_defaults_are_written(tmp_path: Path) -> None:
    """A parameter without any effect on these drives."""
    config = tmp_path / "mine.yaml"
    config.write_text("model: sm\nhorizon: 20\nestimator: {max_yaw_rate: 8.0}\n", encoding="utf-8")
    plan = small_plan(tmp_path, points=3, parameters={"estimator.max_yaw_rate": {"low": 7.0, "high": 20.0}})
    result = tune(config, tmp_path / "out", plan=plan, plant="model:ssm", workers=1)
    assert (result.improved, result.config_path) == (False, tmp_path / "out" / "config.yaml")
    assert result.sentence == "no better than the defaults: none of the points that were tried is"
    assert load_config(result.config_path) == load_config(config)


def test_defaults_that_are_too_slow_give_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def grows(stated: StepTime, _usual: Case, values: dict[str, int]) -> float:
        return stated.p99 * values.get("horizon", 30) / 30.0

    monkeypatch.setattr("diffdrive_mpc.app.tune.search.predicted_p99", grows)
    limit = {"machine": "a small computer", "p99": 4.0e-4, "at_most": 3.8e-4}
    plan = small_plan(tmp_path, points=5, parameters={"horizon": {"low": 12, "high": 40}}, step_time=limit)
    result = tune("ssm", tmp_path / "out", plan=plan, workers=1)
    assert result.improved
    assert result.sentence.endswith("; the defaults break step time, it does not")
    assert load_config(result.config_path).horizon <= 28
    report = (tmp_path / "out" / "tune.md").read_text(encoding="utf-8")
    assert "Step time on a small computer: p99 0.4 ms as stated for the defaults, at most 0.38 ms allowed" in report


def test_a_model_beside_the_configuration_stays_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "robot").mkdir()
    model = Path(__file__).parents[2] / "models" / "parameters" / "sm.yaml"
    (tmp_path / "robot" / "model.yaml").write_text(model.read_text(encoding="utf-8"), encoding="utf-8")
    config = tmp_path / "robot" / "config.yaml"
    config.write_text("model: model.yaml\nhorizon: 20\n", encoding="utf-8")
    plan = small_plan(tmp_path, points=2, parameters={"weights.omega_increment": {"times": [0.5, 20.0]}})
    result = tune(config, tmp_path / "out", plan=plan, workers=1)
    assert "model: ../robot/model.yaml " in result.config_path.read_text(encoding="utf-8")
    assert Path(load_config(result.config_path).model).samefile(tmp_path / "robot" / "model.yaml")


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"parameters": {"weights.acros": {"times": [0.5, 2]}}}, "parameters.weights.acros: the configuration has no"),
        ({"parameters": {"horizon": {"low": 40, "high": 50}}}, "the configuration has 30, which is not between 40 and"),
        ({"parameters": {"horizon": {"low": 10, "high": 900}}}, "horizon: Input should be less than or equal to"),
        ({"parameters": {"horizon": {"low": 10}}}, "give either times: [LOW, HIGH], or low and high"),
        ({"parameters": {"model": {"times": [0.5, 2]}}}, "parameters.model: its value is 'ssm'; only numbers are"),
        (
            {"parameters": {"expert.estimator.least_gain": {"low": 4.0, "high": 5.0}}},
            "parameters.expert.estimator.least_gain: the configuration has 0.2, which is not between 4",
        ),
        ({"parameters": {"estimator.load_shift": {"times": [0.5, 2]}}}, "a factor on it is nothing; give low and high"),
        ({"verdict": {"runs": 6, "draw_seed": 2, "first_seed": 601}}, "seeds from 601 on are those of the tuning"),
        ({"objective": {"error": {"position_rmse": {"mean": 1}}}}, "there is no column 'position_rmse'; known: steps"),
        ({"factors": {"model": "sm"}}, "factors.model: the tuning itself says that; leave it out"),
        ({"spread": {"robot.robot.mass": [0.9, 1.1]}}, "spread.robot.robot.mass: the plant 'model:sm' has no robot"),
        ({"constraints": {"overshoot": {"column": "recovery_overshoot_m"}}}, "give either at_most or times"),
    ],
)
def test_a_mistake_is_one_line(changes: dict[str, object], line: str, tmp_path: Path) -> None:
    said = call("tune", "ssm", "--plan", written(tmp_path, changes), "--out", tmp_path / "out", code=2)
    assert line in " ".join(said.split())
    assert not (tmp_path / "out").exists()


def test_a_storage_that_cannot_be_used_is_one_line(tmp_path: Path) -> None:
    words = ("tune", "ssm", "--plan", written(tmp_path), "--out", tmp_path / "out", "--storage", "nosuch://base")
    assert "error: --storage nosuch://base: " in call(*words, code=2)


def test_the_shipped_plan_spreads_what_the_plant_says(tmp_path: Path) -> None:
    plan = load_plan()
    for of in (plan.tuning, plan.verdict):
        check_definitions(plan.runs(of, 8, {"model": "ssm"}, {}))
    twin = tmp_path / "twin.yaml"
    twin.write_text("description: twice as heavy\nrobot: {mass: 13.7}\nfriction: 0.5\n", encoding="utf-8")
    heavy = plan.model_copy(update={"factors": plan.factors | {"plant": f"mujoco:{twin}"}})
    for one in heavy.runs(plan.tuning, 16, {"model": "ssm"}, {}):
        values = dict(one.robot) | dict(one.surface)
        assert 0.9 * 13.7 <= values["robot.mass"] <= 1.2 * 13.7  # type: ignore[operator]
        assert 0.75 * 0.5 <= values["friction"] <= 1.15 * 0.5  # type: ignore[operator]
    with pytest.raises(ConfigError, match=r"spread\.robot\.robot\.name: there is no number"):
        plan.model_copy(update={"spread": {"robot.robot.name": (0.5, 2.0)}}).runs(plan.tuning, 2, {"model": "ssm"}, {})


DRIVE = "diffdrive_mpc.app.tune.search.drive_all"


def test_a_seed_fixes_the_study_and_an_interruption_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = small_plan(tmp_path)
    whole = searched(plan, tmp_path / "whole")
    assert [one.number for one in whole.points] == list(range(11))
    assert whole.points[0].values == {"weights.across": 700.0, "weights.omega_increment": 35.0, "horizon": 30}
    assert (whole.points[0].value, whole.points[0].usable) == (1.0, True)
    assert 0 < len(whole.usable) < 11
    calls = iter(range(1000))

    def interrupted(*given: object, **named: object) -> list[CampaignRun]:
        # Once after the first fidelity of the first group, once before anything of the last one.
        if next(calls) in (5, 8):
            raise KeyboardInterrupt
        return drive_all(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(DRIVE, interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            searched(plan, tmp_path / "parts")
    assert searched(plan, tmp_path / "parts") == whole
    other = searched(plan.model_copy(update={"search_seed": 1}), tmp_path / "whole")
    assert other.points[0] == whole.points[0]
    assert other.points[1:] != whole.points[1:]


def test_workers_share_a_study(tmp_path: Path) -> None:
    plan = small_plan(tmp_path)
    first = searched(plan.model_copy(update={"points": 6}), tmp_path / "out")
    both = searched(plan, tmp_path / "out", worker=2)
    assert both.points[:6] == first.points
    assert len(both.points) == 11
    # Random numbers of its own: no point is tried twice.
    assert len({tuple(one.values.values()) for one in both.points}) == 11


def test_a_point_with_an_unsafe_command_is_never_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = small_plan(tmp_path)
    free = searched(plan, tmp_path / "free")
    assert free.best.number > 0
    forbidden = free.best.values["weights.omega_increment"]

    def unsafe(definitions: Sequence[Definition], *given: object) -> list[CampaignRun]:
        found = drive_all(definitions, *given)  # type: ignore[arg-type]
        hit = [("weights.omega_increment", forbidden) in one.definition.case.overrides for one in found]
        return [replace(one, row=one.row | {"unsafe_limit": int(bad)}) for one, bad in zip(found, hit, strict=True)]

    monkeypatch.setattr(DRIVE, unsafe)
    held = searched(plan, tmp_path / "held")
    one = held.points[free.best.number]
    assert (one.values, one.usable, one.broken) == (free.best.values, False, "unsafe")
    assert held.best.number != one.number
    assert one not in held.front


def test_a_horizon_that_takes_too_long_is_not_driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def grows(stated: StepTime, usual: Case, values: dict[str, int]) -> float:
        asked.append(values)
        return stated.p99 * values.get("horizon", 30) / 30.0

    monkeypatch.setattr("diffdrive_mpc.app.tune.search.predicted_p99", grows)
    plan = small_plan(tmp_path, step_time={"machine": "a small computer", "p99": 3.0e-4, "at_most": 3.3e-4})
    found = searched(plan, tmp_path / "out")
    long = [one for one in found.points if one.values["horizon"] > 33]  # type: ignore[operator]
    assert long
    assert all((one.fidelity, one.broken, one.usable) == (0, "step time", False) for one in long)
    assert all(one.fidelity for one in found.points if one not in long)
    # What was measured is kept with the study.
    count = len(asked)
    assert count == len({one.values["horizon"] for one in found.points})
    assert searched(plan, tmp_path / "out") == found
    assert len(asked) == count


def test_processor_time_grows_with_the_horizon(tmp_path: Path) -> None:
    stated = StepTime(machine="a small computer", p99=1.0e-3, at_most=2.0e-3)
    usual = small_plan(tmp_path).runs(small_plan(tmp_path).tuning, 1, {"model": "ssm"}, {})[0].case
    assert predicted_p99(stated, usual, {"weights.across": 300.0}) == stated.p99
    assert predicted_p99(stated, usual, {"horizon": 120}) > 1.3 * stated.p99


def test_constraints_may_have_runs_of_their_own(tmp_path: Path) -> None:
    beside = {"column": "recovery_overshoot_m", "runs": 1, "factors": {"scenario": "start_offset"}}
    plan = small_plan(tmp_path, points=6, constraints={"overshoot": beside | {"at_most": -1.0}})
    found = searched(plan, tmp_path / "out")
    # No overshoot is below zero: nothing can be used, the defaults neither, and the defaults remain.
    assert {one.broken for one in found.points if one.fidelity == 2} == {"overshoot"}
    assert (found.usable, found.best.number) == ([], 0)


TERMS = terms_of(
    Objective(
        error={"position_rmse_m": {"mean": 2.0, "cvar": 1.0}},
        effort={"recovery_command_rate_v": {"mean": 0.5}, "recovery_command_energy_v": {"mean": 0.5}},
    )
)
TABLES = st.lists(
    st.lists(st.floats(0.01, 100.0), min_size=12, max_size=12), min_size=len(TERMS), max_size=len(TERMS)
).map(np.array)


def driven(**row: object) -> CampaignRun:
    usual = {"completed": True, "error": "", "position_rmse_m": 0.01, "unsafe_limit": 0}
    usual |= {"recovery_command_rate_v": 1.0, "recovery_command_energy_v": 1.0}
    return CampaignRun(Definition(Case()), "0" * 64, usual | row)  # type: ignore[arg-type]


@given(TABLES, TABLES, st.floats(0.1, 10.0))
def test_the_objective_is_a_weighted_ratio(mine: FloatArray, usual: FloatArray, factor: float) -> None:
    assert float(score(TERMS, usual, usual).value) == pytest.approx(1.0)
    found = score(TERMS, mine, usual)
    assert float(found.value) == pytest.approx(0.75 * float(found.error) + 0.25 * float(found.effort))
    # The unit of a column is of no account, and all figures are homogeneous.
    units = np.linspace(0.5, 20.0, len(TERMS))[:, None]
    assert float(score(TERMS, units * mine, units * usual).value) == pytest.approx(float(found.value))
    assert float(score(TERMS, factor * mine, usual).value) == pytest.approx(factor * float(found.value))


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6), st.booleans()), min_size=1, max_size=12))
def test_no_usable_point_beats_one_of_the_front(listed: list[tuple[int, int, bool]]) -> None:
    points = [TunePoint(k, {}, 1, 1.0, e, f, 1.0, "", usable=u) for k, (e, f, u) in enumerate(listed)]
    found = Searched(points, {})

    def beats(a: TunePoint, b: TunePoint) -> bool:
        return a.error <= b.error and a.effort <= b.effort and (a.error, a.effort) != (b.error, b.effort)

    for one in found.front:
        assert not any(beats(other, one) for other in found.usable)
    for one in found.usable:
        assert any((a.error, a.effort) == (one.error, one.effort) or beats(a, one) for a in found.front)


def test_what_has_to_hold_is_counted() -> None:
    good, bad = driven(), driven(unsafe_slew=3)
    assert in_words(broken([good, good], [good, good], TERMS)) == ""
    assert in_words(broken([good, bad], [good, good], TERMS)) == "unsafe"
    assert in_words(broken([driven(completed=False), good], [good, good], TERMS)) == "not completed"
    assert in_words(broken([driven(completed=False), good], [driven(completed=False), good], TERMS)) == ""
    assert in_words(broken([driven(position_rmse_m=None), good], [good, good], TERMS)) == "not driven"


def test_a_constraint_counts_the_worst_run_that_has_the_column() -> None:
    usual = [driven(recovery_overshoot_m=0.02), driven(recovery_overshoot_m=None)]
    fixed = Constraint(column="recovery_overshoot_m", at_most=0.04)
    times = Constraint(column="recovery_overshoot_m", times=1.5)
    mine = [driven(recovery_overshoot_m=0.01), driven(recovery_overshoot_m=0.035)]
    assert exceeded(fixed, mine, usual, "overshoot") == pytest.approx(-1.0 / 8.0)
    assert exceeded(times, mine, usual, "overshoot") == pytest.approx(1.0 / 6.0)
    with pytest.raises(ConfigError, match="an overshoot needs a scenario"):
        exceeded(fixed, mine, [driven()], "overshoot")


def test_what_two_share_run_by_run_does_not_widen_their_interval() -> None:
    rng = np.random.default_rng(3)
    shared = rng.uniform(1.0, 9.0, 40)
    usual = np.array([shared])
    mine = np.array([0.8 * shared + rng.normal(0.0, 0.01, 40)])

    def ratio(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(a.mean(axis=-1) / b.mean(axis=-1))[0]

    found = BootstrapEstimate.of_same_runs((mine, usual), ratio)
    assert found.low < 0.8 < found.high
    assert found.high - found.low < 0.01
    assert BootstrapEstimate.of_same_runs((usual, usual), ratio) == BootstrapEstimate(1.0, 1.0, 1.0)
