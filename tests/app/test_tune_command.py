"""`diffdrive-mpc tune` from the command line: what it leaves, what it says, and mistakes in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from opened_report import content_of
from tune_parts import small_plan, written

from commands import call
from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.app.tune.study import tune
from diffdrive_mpc.app.tune.tune_file import StepTime, load_plan
from diffdrive_mpc.bench.campaign.check import check_definitions
from diffdrive_mpc.bench.case import Case


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
    monkeypatch.setattr("diffdrive_mpc.bench.campaign.engine.drive", None)
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
        ({"parameters": {"estimator.crab": {"times": [0.5, 2]}}}, "a factor on it is nothing; give low and high"),
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
