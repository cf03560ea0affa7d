"""Files of a report: exact fields, no partial results, and no paths of the machine."""

import hashlib
import json
import math
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_parts import quick_outcome
from bench_parts import rows as rows_of
from pandas import DataFrame

from diffdrive_mpc import ConfigError
from diffdrive_mpc.bench.comparison.figures import report_figures
from diffdrive_mpc.bench.comparison.page import page_contents
from diffdrive_mpc.bench.comparison.plan import default_settings
from diffdrive_mpc.bench.comparison.results import ComparisonResults, describe_incomplete, json_row
from diffdrive_mpc.bench.comparison.study import ComparisonStudy
from diffdrive_mpc.bench.comparison.tables import report_tables, summary_table
from diffdrive_mpc.bench.experiment import mean
from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.report_folder import CONTENTS, staged
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.study import write_report
from diffdrive_mpc.bench.timing import TimingPass

FIELDS = {
    name: kind
    for kind, names in (
        (str, "controller model trajectory plant surface sensors"),
        (int, "seed horizon steps"),
        (bool, "completed"),
        (
            float,
            "position_rmse_m position_mean_m position_std_m position_max_m heading_rmse_rad heading_mean_rad "
            "heading_std_rad heading_max_rad course_rmse_rad lateral_rmse_m lateral_mae_m lateral_p95_m "
            "lateral_max_m in_band_percent step_time_p50_s step_time_p95_s step_time_p99_s step_time_max_s "
            "solve_time_p50_s solve_time_p95_s solve_time_p99_s solve_time_max_s iterations_mean "
            "iterations_max",
        ),
        (int, "deadline_misses fallbacks"),
        (bool, "stopped"),
        (float, "behind_max_s method_unlimited_percent method_active_set_percent method_backend_percent"),
        (int, "not_solved"),
        (float, "timed_clean_percent"),
    )
    for name in names.split()
}
"""Type of each published field in order; the names `path_..._percent` are deprecated."""


@pytest.fixture(scope="module")
def results(outcome: RunOutcome) -> ComparisonResults:
    peer = quick_outcome(trajectory="cane", controller="kanayama", model="none")
    horizon = quick_outcome(trajectory="cane", overrides=(("horizon", 15),))
    settings = default_settings().model_copy(update={"seeds": (0,), "horizons": (15, 30)})
    return ComparisonResults(settings, rows_of(outcome, peer), rows_of(horizon, outcome), TimingPass(0.9, 0.2, 1.4e-5))


def write_out(
    results: ComparisonResults, folder: Path, on_figure: Callable[[], None] = lambda: None
) -> dict[str, object]:
    """Write the report into `folder`; return its `meta` part."""
    study = ComparisonStudy(results.settings)
    report = study.report(results, 12.3)
    meta = describe_run(12.3) | report.meta
    write_report(study, report, meta, folder, on_figure)
    return meta


def test_report_is_complete_and_valid(results: ComparisonResults, outcome: RunOutcome, tmp_path: Path) -> None:
    drawn_figures: list[int] = []
    write_out(results, tmp_path, lambda: drawn_figures.append(1))
    data = json.loads((tmp_path / "bench.json").read_text())
    assert set(data) == {"meta", "runs"}
    assert [list(run) for run in data["runs"]] == [list(FIELDS)] * 3
    published = json_row(outcome.row, ("scenario", "timing"))
    assert {name: type(value) for name, value in published.items()} == FIELDS and published["completed"] is True
    assert [run["horizon"] for run in data["runs"]] == [30, None, 15]
    assert data["meta"]["machine"]["cores"] >= 1
    figures = sorted(path.name for path in (tmp_path / "figures").iterdir())
    expected = ["horizon.png", "overview.png", "ssm-cane.png", "step-time.png"]
    assert figures == expected
    assert len(drawn_figures) == len(report_figures(results)) == len(expected)
    text = (tmp_path / "bench.md").read_text()
    assert all(f"(figures/{name})" in text for name in expected)
    assert all(f"## {table.title}" in text for table in report_tables(results))
    assert str(tmp_path) not in text + json.dumps(data)
    assert str(Path.home()) not in text + json.dumps(data)


def test_tables_show_means_over_all_runs_of_any_length_and_outcome(outcome: RunOutcome) -> None:
    rows = rows_of(*(RunOutcome(replace(outcome.case, seed=seed), outcome.run) for seed in range(3)))
    rows = rows.assign(position_rmse_m=[0.1, 0.2, 0.6], steps=[1, 2, 3], completed=[True, True, False])
    (cells,) = summary_table(rows).rows
    assert (*cells[:2], cells[-1]) == ("SSM", "0.3000", "2/3")
    assert mean(rows, "position_rmse_m") == pytest.approx(0.3)
    unknown = rows.assign(position_rmse_m=[0.1, np.nan, 0.6])
    assert (summary_table(unknown).rows[0][1], math.isnan(mean(unknown, "position_rmse_m"))) == ("-", True)


@pytest.mark.parametrize(
    ("mpc", "peer", "value", "note"),
    [
        ((2.4, True), (2.5, True), "2.4 mm", "SSM; worst: kanayama 2.5 mm"),
        ((2.6, True), (2.5, True), "2.5 mm", "kanayama; best MPC: SSM 2.6 mm"),
        ((2.6, True), (2.5, False), "2.6 mm", "SSM; mean over paths and seeds"),
        ((2.4, False), (2.5, True), "2.5 mm", "kanayama; no MPC completed every run"),
        ((2.4, False), (2.5, False), "-", "no controller completed every run"),
    ],
)
def test_min_error_is_taken_from_controllers_that_completed_every_run(results, mpc, peer, value, note) -> None:
    main, errors = results.main.iloc[[0, 1, 0, 1]].reset_index(drop=True), 1e-3 * np.array([mpc[0], peer[0]] * 2)
    main = main.assign(position_rmse_m=errors, completed=[True, True, mpc[1], peer[1]])
    page = page_contents(replace(results, main=main))
    card = page.key_figures[1]
    assert ("Not ranked" in page.summary[0]) is not (mpc[1] and peer[1])
    assert (card.label, card.value, card.note) == ("minimum position error, RMSE", value, note)


def test_incomplete_runs_of_the_mpc_are_reported(results: ComparisonResults) -> None:
    assert describe_incomplete(results) is None
    mpc, peer = (RunOutcome(case, run) for case, run in zip(results.main["case"], results.main["run"], strict=True))
    stopped = replace(mpc.run, true_pose=mpc.run.true_pose + 1.0)
    assert not stopped.metrics.completed
    message = describe_incomplete(
        replace(results, main=rows_of(RunOutcome(mpc.case, stopped), peer), horizon=DataFrame())
    )
    assert message.startswith("1 of 1 runs of mpc did not complete, the first: ssm on cane, horizon 30, seed 0")
    assert describe_incomplete(replace(results, main=rows_of(mpc, RunOutcome(peer.case, stopped)))) is None


@pytest.mark.parametrize("kind", ["folder", "link"])
def test_late_conflict_replaces_no_file(kind: str, tmp_path: Path) -> None:
    out, user_file = tmp_path / "out", tmp_path / "mine"
    out.mkdir()
    (out / "a.txt").write_text("old")
    user_file.write_text("mine")
    if kind == "folder":
        (out / "b.txt").mkdir()
    else:
        (out / "b.txt").symlink_to(user_file)
    with pytest.raises(ConfigError, match=r"'b\.txt' exists and is no"), staged(out) as folder:
        (folder / "a.txt").write_text("new")
        (folder / "b.txt").write_text("new")
    assert (out / "a.txt").read_text() == "old"
    assert user_file.read_text() == "mine"
    assert sorted(path.name for path in out.iterdir()) == ["a.txt", "b.txt"]


def test_failure_leaves_all_files_unchanged(tmp_path: Path) -> None:
    (tmp_path / "bench.md").write_text("old")
    with pytest.raises(ZeroDivisionError), staged(tmp_path) as folder:
        (folder / "bench.md").write_text("half")
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["bench.md"]
    assert (tmp_path / "bench.md").read_text() == "old"
    for out in (tmp_path / "new", tmp_path / "one" / "two" / "three"):
        with pytest.raises(ZeroDivisionError), staged(out):
            raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["bench.md"]


def _write(out: Path, owner: str, *names: str, shared: bool = False) -> None:
    with staged(out, owner=owner, shared=shared) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(f"{owner} {name}", encoding="utf-8")


def _files_in(out: Path) -> set[str]:
    return {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} - {CONTENTS}


def test_results_of_the_same_command_are_replaced_completely(tmp_path: Path) -> None:
    """Old figures of the command are removed; files that users added or changed stay."""
    _write(tmp_path, "bench", "bench.md", "figures/a.png", "figures/b.png", "old/c.png")
    (tmp_path / "figures" / "mine.png").write_text("mine", encoding="utf-8")
    (tmp_path / "figures" / "b.png").write_text("retouched by hand", encoding="utf-8")
    _write(tmp_path, "bench", "bench.md", "figures/z.png")
    assert _files_in(tmp_path) == {"bench.md", "figures/b.png", "figures/mine.png", "figures/z.png"}
    assert not (tmp_path / "old").exists()


def test_command_that_would_replace_a_file_of_the_user_is_refused(tmp_path: Path) -> None:
    """A copied folder, whose files have new times, is not changed by hand."""
    _write(tmp_path / "first", "bench", "bench.md", "report.html")
    out = shutil.copytree(tmp_path / "first", tmp_path / "copy")
    with staged(out, files=("bench.md",), owner="bench"):
        pass
    for name in ("bench.md", "report.html"):
        (out / name).write_text("mine", encoding="utf-8")
        with (
            pytest.raises(ConfigError, match=f"'{name}' was added or changed by hand; move it or choose another"),
            staged(out, files=("bench.md", "report.html"), owner="bench"),
        ):
            raise AssertionError("the command must be refused")
        (out / name).unlink()


def test_results_of_two_commands_do_not_replace_each_other(tmp_path: Path) -> None:
    """The page of the second command has a different name, also in later runs; files of the first command stay."""
    _write(tmp_path, "bench", "bench.md", "report.html")
    _write(tmp_path, "tracking", "tracking.md", "report.html")
    _write(tmp_path, "tracking", "tracking.md", "report.html")
    _write(tmp_path, "bench", "bench.md", "report.html")
    assert _files_in(tmp_path) == {"bench.md", "report.html", "tracking.md", "tracking.html"}
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "bench report.html"
    assert (tmp_path / "tracking.html").read_text(encoding="utf-8") == "tracking report.html"
    with (
        pytest.raises(ConfigError, match=r"'bench.md' is a result of `bench`; choose another folder"),
        staged(tmp_path, files=("bench.md",), owner="twin"),
    ):
        raise AssertionError("the command must be refused")


def test_failed_move_leaves_the_old_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stale results are also preserved."""
    _write(tmp_path, "bench", "a", "b")
    original = {name: (tmp_path / name).read_bytes() for name in ("a", "b", CONTENTS)}
    move = Path.replace

    def replace_on_a_full_disk(self: Path, target: Path) -> Path:
        if self.name == "c":
            raise OSError("disk full")
        return move(self, target)

    monkeypatch.setattr(Path, "replace", replace_on_a_full_disk)
    with pytest.raises(OSError, match="disk full"):
        _write(tmp_path, "bench", "a", "new/b", "c")
    assert _files_in(tmp_path) == {"a", "b"} and not (tmp_path / "new").exists()
    assert {name: (tmp_path / name).read_bytes() for name in ("a", "b", CONTENTS)} == original


@pytest.mark.parametrize("contents", ["", "[]", "{", '{"a": 1}', '{"a": {"by": "bench"}}', '{"../x": null}'])
def test_damaged_list_of_contents_is_ignored(tmp_path: Path, contents: str) -> None:
    """All files are treated as files of the user."""
    (tmp_path / CONTENTS).write_text(contents, encoding="utf-8")
    (tmp_path / "a").write_text("mine", encoding="utf-8")
    _write(tmp_path, "bench", "b")
    assert _files_in(tmp_path) == {"a", "b"}


def test_file_outside_the_folder_is_never_stale(tmp_path: Path) -> None:
    """The list of contents, which a user may edit, names a file outside the folder."""
    out, user_file = tmp_path / "out", tmp_path / "mine"
    user_file.write_text("mine", encoding="utf-8")
    _write(out, "bench", "a")
    contents = f'{{"../mine": {{"by": "bench", "sha256": "{hashlib.sha256(user_file.read_bytes()).hexdigest()}"}}}}'
    (out / CONTENTS).write_text(contents, encoding="utf-8")
    _write(out, "bench", "b")
    assert user_file.read_text(encoding="utf-8") == "mine"


def _hold_folder(out: str, ready: object, shared: bool) -> None:
    with staged(Path(out), owner="bench", shared=shared) as folder:
        (folder / "first").write_text("x", encoding="utf-8")
        ready.set()  # type: ignore[attr-defined]
        time.sleep(60)


@pytest.mark.parametrize("shared", [False, pytest.param(True, marks=pytest.mark.system)])
def test_second_command_is_refused_until_the_first_has_ended_or_was_killed(tmp_path: Path, shared: bool) -> None:
    """A killed command leaves no lock, and its unfinished files are removed; commands may share a folder."""
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    process = context.Process(target=_hold_folder, args=(str(tmp_path), ready, shared))
    process.start()
    try:
        assert ready.wait(60)
        if shared:
            _write(tmp_path, "bench", "second", shared=True)
        else:
            with pytest.raises(ConfigError, match="another command is writing to this folder"):
                _write(tmp_path, "tracking", "second")
    finally:
        process.kill()
        process.join()
    (unfinished,) = tmp_path.glob(".unfinished-*")
    os.utime(unfinished, (0, 0))
    _write(tmp_path, "bench", "third", shared=shared)
    assert "third" in _files_in(tmp_path)
    assert not list(tmp_path.glob(".unfinished-*"))
