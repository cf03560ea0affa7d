"""`diffdrive-mpc tune`: command, search, and comparison."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from opened_report import content_of

from commands import call
from diffdrive_mpc import load_config
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc_extras.tuning.search import ConfigurationSearch, TunePoint
from diffdrive_mpc_extras.tuning.study import Comparison, TuningOutcome, tune
from diffdrive_mpc_extras.tuning.tune_file import load_plan


@pytest.fixture(scope="module")
def tuned_folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return the result folder of a tuning, and the output of its command."""
    folder = tmp_path_factory.mktemp("tuned")
    arguments = ("tune", "ssm", "--plan", write_plan(folder), "--points", "8", "--out", folder / "out", "--jobs", "1")
    return folder / "out", " ".join(call(*arguments).split())


def search_points(folder: Path, jobs: int = 1, **changes: object) -> list[TunePoint]:
    search = ConfigurationSearch("ssm", load_plan(write_plan(folder, changes)))
    with ProgressBar("searching") as bar:
        return search.run(jobs, bar)


def test_command_writes_configuration_and_report(tuned_folder: tuple[Path, str]) -> None:
    out, output = tuned_folder
    report = (out / "tune.md").read_text(encoding="utf-8")
    assert "## Comparison on the report seeds\n" in report
    assert "## Best point of the search\n" in report
    assert (out / "figures" / "search.png").is_file()
    result = json.loads((out / "tune.json").read_text(encoding="utf-8"))
    assert result["meta"]["sentence"] in output
    assert len(result["points"]) == 8
    page = content_of(out / "report.html")
    assert page["key_figures"][0]["value"] == ("yes" if result["meta"]["is_better"] else "no")


def test_configuration_changes_only_if_the_report_seeds_confirm_it(tuned_folder: tuple[Path, str]) -> None:
    out, _ = tuned_folder
    result = json.loads((out / "tune.json").read_text(encoding="utf-8"))
    tuned, start = load_config(out / "config.yaml"), load_config("ssm")
    is_better = result["change"]["high"] < 0.0
    assert result["meta"]["is_better"] == is_better
    assert (tuned != start) == is_better
    assert tuned.model_copy(update={"weights": start.weights, "horizon": start.horizon}) == start
    assert ("was 700" in (out / "config.yaml").read_text(encoding="utf-8")) == is_better


def test_parameter_without_effect_does_not_change_the_configuration(tmp_path: Path) -> None:
    config = tmp_path / "start.yaml"
    config.write_text("model: sm\nhorizon: 20\nestimator: {max_yaw_rate: 8.0}\n", encoding="utf-8")
    changes = {"parameters": {"estimator.max_yaw_rate": {"low": 7.0, "high": 20.0}}}
    result = tune(config, tmp_path / "out", plan=write_plan(tmp_path, changes), plant="model:ssm", points=3, jobs=1)
    assert not result.is_better
    assert result.sentence == "no better than the start configuration: no point has a smaller error on the tuning seeds"
    assert load_config(result.config_path) == load_config(config)


def test_shipped_plan_adapts_paths_and_parameters_to_a_configuration_file(tmp_path: Path) -> None:
    config = tmp_path / "slow.yaml"
    config.write_text("model: sm\nlimits: {v: 0.4, omega: 0.7, omega_slew: {accelerate: 6.0, brake: 4.7}}\n")
    plan = load_plan().model_copy(update={"runs": {"plant": ("model:sm",), "trajectory": ("square",)}})
    search = ConfigurationSearch(str(config), plan)
    assert search.skipped == ["limits.omega_slew"] and "limits.v_slew" in search.start
    with ProgressBar("driving") as bar:
        rows = search.drive(search.start, [0], 1, bar)
    assert rows["completed"].all() and list(rows["trajectory"]) == ["square scaled to the robot"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parameters": {"weights.acros": {"times": [0.5, 2]}}}, "parameters.weights.acros: the configuration has no"),
        ({"parameters": {"horizon": {"low": 10, "high": 900}}}, "horizon: Input should be less than or equal to"),
        ({"report_seeds": {"first": 600, "count": 4}}, "report_seeds: 600 to 603 overlap with tuning_seeds"),
    ],
)
def test_invalid_plan_is_refused_in_one_line(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    output = call("tune", "ssm", "--plan", write_plan(tmp_path, changes), "--out", tmp_path / "out", code=2)
    assert message in " ".join(output.split())


def test_search_depends_on_the_seed_but_not_on_the_number_of_processes(tmp_path: Path) -> None:
    points = search_points(tmp_path)
    assert [point.number for point in points] == list(range(6))
    assert points[0].values == {"weights.across": 700.0, "horizon": 30}
    assert search_points(tmp_path, jobs=2) == points
    other_seed = search_points(tmp_path, sampler_seed=1)
    assert other_seed[0] == points[0]
    assert other_seed[1:] != points[1:]


def run_rows(errors: list[float], completed: list[bool]) -> pd.DataFrame:
    ended = ["" if is_complete else "off the path" for is_complete in completed]
    return pd.DataFrame({"position_rmse_m": errors, "completed": completed, "ended": ended})


@pytest.mark.parametrize(
    ("factor", "failures", "is_better"), [(0.8, 0, True), (0.8, 1, False), (1.0, 0, False), (1.2, 0, False)]
)
def test_better_point_has_a_lower_error_and_no_more_failures(factor: float, failures: int, is_better: bool) -> None:
    noise = np.random.default_rng(3)
    start = noise.uniform(1e-3, 9e-3, 40)
    best = factor * start + noise.normal(0.0, 1e-5, 40)
    completed = [k >= failures for k in range(40)]
    comparison = Comparison(run_rows(list(start), [True] * 40), run_rows(list(best), completed), start, best)
    assert comparison.is_better == is_better
    # Runs are paired by seed: their common spread does not widen the interval.
    assert comparison.change().high - comparison.change().low < 0.01
    outcome = TuningOutcome([], TunePoint(1, {"horizon": 20}, 0.0, 0), {"horizon": 30}, comparison)
    assert outcome.sentence.startswith("better than" if is_better else "no better than")
    assert outcome.written == ({"horizon": 20} if is_better else {})


SHORT = "name: short\nsegments:\n- {v: 0.4, omega: 0.5, duration: 0.6}\n"
PLAN = """
description: short drives of a model
points: 6
parameters:
  weights.across: {times: [0.2, 5.0]}
  horizon: {low: 15, high: 40}                      # steps
runs: {plant: "model:sm", trajectory: short.yaml}
tuning_seeds: {first: 600, count: 1}
report_seeds: {first: 700, count: 4}
"""


def write_plan(folder: Path, changes: Mapping[str, object] | None = None) -> Path:
    """Write the plan with changed top-level values, and its path file in the same folder."""
    (folder / "short.yaml").write_text(SHORT, encoding="utf-8")
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(PLAN) | dict(changes or {})), encoding="utf-8")
    return path
