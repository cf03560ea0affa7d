"""HTML reports: linked views in a real browser, their contents, and their warnings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from opened_report import check_page, check_report, content_of, open_offline
from plotly.graph_objects import Figure

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.html_report import page as parts
from diffdrive_mpc.bench.html_report.document import json_text, page_text
from diffdrive_mpc.bench.html_report.origin import mpc_config
from diffdrive_mpc.bench.html_report.run_series import ERROR, rounded_list, run_series, select_ticks
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.table import Table

QUICK = ("--plant", "model:ssm", "--surface", "ideal", "--sensors", "perfect", "--trajectory", "cane")
HOSTILE = '<script>document.title = "taken"</script><b>&amp;'


@pytest.fixture(scope="module")
def run_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_command(tmp_path_factory.mktemp("single"), "simulate", *QUICK)


def run_command(folder: Path, *arguments: str) -> Path:
    invoke(app, *arguments, "--out", folder)
    return folder / "report.html"


@pytest.mark.system("browser")
def test_pointing_at_one_view_marks_the_same_tick_in_the_other(run_page: Path) -> None:
    with open_offline(run_page) as page:
        box = page.locator("#times").bounding_box()
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.1 * box["height"])
        page.wait_for_selector("#plane .hoverlayer .hovertext", state="attached")
        check_page(page)


def test_plotly_accepts_every_figure(run_page: Path, tmp_path: Path, outcome: RunOutcome) -> None:
    path = tmp_path / "report.html"
    path.write_text(page_text(page_of_all_views("a", outcome)), encoding="utf-8")
    for report in (run_page, path):
        views = content_of(report)["views"]
        figures = [view.get(name) for view in views for name in ("figure", "plane", "times")]
        plotly_figures = [Figure(figure) for figure in figures if figure]
        assert len(plotly_figures) == len(views) + 1  # the view of runs has two figures
        assert all({"labels", "group"} == set(trace.meta) for figure in plotly_figures for trace in figure.data)
    plane, times = (Figure(content_of(run_page)["views"][0][name]) for name in ("plane", "times"))
    driven_trace = next(trace for trace in plane.data if trace.name == "driven")
    lateral = times.data[0]
    assert driven_trace.meta == lateral.meta
    assert len(driven_trace.x) == len(lateral.x)


def page_of_all_views(name: str, outcome: RunOutcome) -> parts.Page:
    """Build a page with every kind of view; every name that can come from a file is `name`."""
    labels = {"controller": name, "path": "p"}
    series = [parts.Series(name, [1.0, 2.0], [1.0, None], text=[name, name], labels=labels)]
    series += [parts.Series(f"{name}2", [1.0, 2.0], [2.0, 3.0], 1, "bars", low=[1.0, 2.0], high=[3.0, 4.0])]
    series += [parts.Series(f"{name}3", [1.0, 2.0], [2.0, 3.0], 1, low=[1.0, 2.0], high=[3.0, 4.0])]
    axis = parts.GridAxis(name, [1.0, 2.0])
    marks = [parts.Mark(1.5, name), parts.Mark(1.5, name, upright=True)]
    views = [
        parts.RunViews([run_series(outcome.run, name, points=50, labels=labels)], name),
        parts.Chart(name, parts.Axis(name), parts.Axis(name, "log", (0.0, 1.0)), series, name, marks),
        parts.GridMap(name, axis, axis, [[1.0, None], [2.0, 3.0]], name, [[True, False], [False, False]]),
    ]
    figures, toggles = [parts.KeyFigure(name, name, name)], [parts.Toggle("controller", (name,), (name,), styled=True)]
    warnings, configurations = [parts.PageWarning(name, name)], [parts.ConfigurationView(name, name)]
    content = parts.PageContents([name], [name], figures, toggles, views, warnings, configurations)
    table = Table(name, (name, "b [m]"), ((name, "1"),), note=name)
    return parts.Page(name, name, content, [table], parts.Origin(name, [(name, name)]))


@pytest.mark.system("browser")
def test_every_kind_of_view_is_drawn_and_names_from_files_are_text(tmp_path: Path, outcome: RunOutcome) -> None:
    name = HOSTILE
    path = tmp_path / "report.html"
    path.write_text(page_text(page_of_all_views(name, outcome)), encoding="utf-8")
    check_report(path)
    with open_offline(path) as page:
        assert page.title() == name
        assert page.locator("#title").inner_text() == name
        assert page.locator("main script, main b:not(svg b)").count() == 0
        labels = page.evaluate("[...document.querySelectorAll('.charts .plot text')].map((label) => label.textContent)")
        assert name in labels


def test_content_cannot_end_its_script() -> None:
    assert "<" not in json_text({"a": "</script><!--"})


def test_thinned_runs_preserve_peaks_and_series_preserve_values(outcome: RunOutcome) -> None:
    run = outcome.run
    ticks = select_ticks(run, 60)
    assert len(ticks) == 60
    assert (np.diff(ticks) > 0).all()
    assert run.errors.position[ticks].max() == run.errors.position.max()
    series = run_series(run, "a", points=60)
    path = next(entry for entry in series.plane if entry.name == "driven")
    assert np.array(path.x, float) == pytest.approx(run.true_pose[ticks, 0], abs=5.1e-4)
    lateral, along = (np.array(entry.y, float) for entry in series.panes[ERROR])
    assert lateral == pytest.approx(1e3 * run.errors.lateral[ticks], abs=0.051)
    assert (np.abs(along) <= 1e3 * run.errors.position[ticks] + 0.1).all()
    assert rounded_list(np.array([np.nan, 1.26]), 1) == [None, 1.3]


def test_normal_run_has_no_warnings(outcome: RunOutcome) -> None:
    run = outcome.run.with_step_time(np.full(len(outcome.run.time), 1e-3))
    assert run_warnings(run, mpc_config(outcome.case)) == []


def test_every_problem_of_a_run_gives_a_warning_with_a_remedy(outcome: RunOutcome) -> None:
    run, config = outcome.run, mpc_config(outcome.case)
    count = len(run.time)
    modes = ("BRAKING",) * 4 + ("REUSED_PLAN",) * 2 + run.modes[6:]
    times = np.where(np.arange(count) == 7, 1.0, 1e-3)
    without_poses = tuple(
        replace(measurement, pose=None) if count // 3 < k < 2 * count // 3 else measurement
        for k, measurement in enumerate(run.measurements)
    )
    commands = np.full((count, 2), [config.limits.v, 0.0])
    faulty = replace(
        run, modes=modes, measurements=without_poses, command=commands, ended="it was lost", messages=("why",) * count,
        true_pose=run.true_pose + 9.0, solver_methods=("osqp",) * count,
    )  # fmt: skip
    warnings = run_warnings(faulty.with_step_time(times), config, "SSM")
    texts = " ".join(warning.text for warning in warnings)
    for expected in (
        "it was lost",
        "BRAKING at 4 ticks",
        "REUSED_PLAN at 2 ticks",
        "1 tick took longer",
        "Poses were missing once",
    ):
        assert expected in texts
    assert "v at 100 %" in texts
    assert "A backend had to solve 100 %" in texts
    assert "“why”" in texts
    assert all(warning.text.startswith("SSM: ") and warning.remedy for warning in warnings)
