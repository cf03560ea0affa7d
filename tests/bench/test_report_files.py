"""The files of a report: exact fields, no half-written results, nothing about the machine's paths."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_parts import quick_outcome

from bench.atomic import staged
from bench.experiment import default_experiment
from bench.figures.case import draw_case
from bench.figures.draw import count_figures, file_name
from bench.report import write_report
from bench.results import Results, describe, groups, row
from bench.runner import Outcome
from bench.table import Table
from bench.tables import horizon_table, report_tables, summary_table
from models.checked_yaml import ConfigError

FIELDS = {
    "controller": str,
    "model": str,
    "trajectory": str,
    "plant": str,
    "surface": str,
    "sensors": str,
    "seed": int,
    "horizon": int,
    "steps": int,
    "completed": bool,
    "position_rmse_m": float,
    "position_mean_m": float,
    "position_std_m": float,
    "position_max_m": float,
    "heading_rmse_rad": float,
    "heading_mean_rad": float,
    "heading_std_rad": float,
    "heading_max_rad": float,
    "course_rmse_rad": float,
    "lateral_rmse_m": float,
    "lateral_mae_m": float,
    "lateral_p95_m": float,
    "lateral_max_m": float,
    "in_band_percent": float,
    "step_time_p50_s": float,
    "step_time_p95_s": float,
    "step_time_p99_s": float,
    "step_time_max_s": float,
    "deadline_misses": int,
    "fallbacks": int,
}


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return quick_outcome(trajectory="cane")


@pytest.fixture(scope="module")
def results(outcome: Outcome) -> Results:
    peer = quick_outcome(trajectory="cane", controller="kanayama", model="none")
    short = quick_outcome(trajectory="cane", overrides=(("horizon", 15),))
    experiment = default_experiment().model_copy(update={"seeds": (0,), "horizons": (15, 30)})
    return Results(experiment, (outcome, peer), (short, outcome), describe(experiment, 12.3, 0.99))


def test_a_row_has_exactly_the_published_fields(outcome: Outcome) -> None:
    values = row(outcome)
    assert list(values) == list(FIELDS)
    for name, kind in FIELDS.items():
        assert type(values[name]) is kind, name
    assert values["completed"] is True
    assert values["horizon"] == 30


def test_a_swept_value_is_added_to_its_row(outcome: Outcome) -> None:
    case = outcome.case.with_override("weights.across", 200.0)
    assert row(Outcome(case, outcome.run), with_settings=True)["set"] == {"weights.across": 200.0}


def test_what_cannot_be_computed_is_null(outcome: Outcome) -> None:
    broken = outcome.run.true_pose.copy()
    broken[5] = np.nan
    values = row(Outcome(outcome.case, replace(outcome.run, true_pose=broken)))
    assert values["position_rmse_m"] is None
    assert values["completed"] is False


def test_a_report_is_complete_and_valid(results: Results, tmp_path: Path) -> None:
    done: list[int] = []
    write_report(results, tmp_path, lambda: done.append(1))
    data = json.loads((tmp_path / "bench.json").read_text())
    assert set(data) == {"meta", "runs"}
    assert [set(run) for run in data["runs"]] == [set(FIELDS)] * 3
    assert [run["horizon"] for run in data["runs"]] == [30, None, 15]
    assert data["meta"]["machine"]["cores"] >= 1
    pictures = sorted(path.name for path in (tmp_path / "figures").iterdir())
    expected = ["horizon.png", "kanayama-cane.png", "overview.png", "ssm-cane.png", "step-time.png"]
    assert pictures == expected
    assert len(done) == count_figures(results) == len(expected)
    text = (tmp_path / "bench.md").read_text()
    assert all(f"(figures/{name})" in text for name in expected)
    assert all(f"## {table.title}" in text for table in report_tables(results))
    assert str(tmp_path) not in text + json.dumps(data)
    assert str(Path.home()) not in text + json.dumps(data)


def test_a_figure_is_the_same_file_every_time(outcome: Outcome, tmp_path: Path) -> None:
    for name in ("first.png", "second.png"):
        draw_case(outcome.run, "title", tmp_path / name)
    assert (tmp_path / "first.png").read_bytes() == (tmp_path / "second.png").read_bytes()


def test_tables_show_means_over_runs_and_worst_cases(outcome: Outcome) -> None:
    worse = replace(outcome.run, true_pose=outcome.run.true_pose + np.array([0.02, 0.0, 0.0]))
    runs = [outcome, Outcome(replace(outcome.case, seed=1), worse)]
    (cells,) = summary_table(runs).rows
    a, b = outcome.run.metrics, worse.metrics
    assert cells[0] == "SSM"
    assert float(cells[1]) == pytest.approx(0.5 * (a.position_rmse_m + b.position_rmse_m), abs=5e-5)
    assert float(cells[2]) == pytest.approx(b.position_max_m, abs=5e-5)
    assert cells[-1] == "2/2"


def test_the_horizon_table_is_sorted_by_horizon(results: Results) -> None:
    assert [cells[:2] for cells in horizon_table(results.horizon).rows] == [("SSM", "15"), ("SSM", "30")]


def test_groups_name_only_what_varies(outcome: Outcome) -> None:
    slippery = Outcome(replace(outcome.case, surface="slippery"), outcome.run)
    swept = [Outcome(outcome.case.with_override("horizon", steps), outcome.run) for steps in (5, 10)]
    assert list(groups([outcome])) == ["SSM"]
    assert list(groups([outcome, slippery])) == ["SSM, ideal", "SSM, slippery"]
    assert list(groups(swept)) == ["SSM, horizon=5", "SSM, horizon=10"]


def test_results_replace_old_ones_and_leave_other_files(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.png").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    with staged(tmp_path) as folder:
        (folder / "figures").mkdir()
        (folder / "figures" / "new.png").write_text("new")
        assert (tmp_path / "figures" / "old.png").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figures", "notes.txt"]
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["new.png"]


def test_a_failure_leaves_everything_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "bench.md").write_text("old")
    with pytest.raises(ZeroDivisionError), staged(tmp_path) as folder:
        (folder / "bench.md").write_text("half")
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["bench.md"]
    assert (tmp_path / "bench.md").read_text() == "old"
    with pytest.raises(ZeroDivisionError), staged(tmp_path / "new"):
        raise ZeroDivisionError
    assert not (tmp_path / "new").exists()


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ConfigError, match="cannot be written to"), staged(tmp_path / "out"):
        pass


def test_a_table_needs_a_cell_for_every_column() -> None:
    with pytest.raises(ValueError, match="2 cells for 3 columns"):
        Table("t", ("a", "b", "c"), (("1", "2"),))
    assert Table("t", ("a", "b [m]"), (("x|y", "1"),)).markdown().splitlines() == [
        "## t",
        "",
        "| a | b [m] |",
        "| --- | ---: |",
        "| x\\|y | 1 |",
    ]


def test_file_names_suit_every_file_system() -> None:
    assert file_name("SSM, surface=default: s") == "ssm-surface-default-s"
