"""Reports as pages: the linked views in a real browser, what they hold of a run, and what they warn of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench_parts import quick_outcome
from opened_report import check_page, check_report, content_of, opened

from browser import opened_browser
from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.html_report.document import json_text, page_text
from diffdrive_mpc.bench.html_report.origin import case_config
from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    GridAxis,
    GridMap,
    KeyFigure,
    Origin,
    Page,
    RunViews,
    Series,
    Shown,
    Toggle,
    Warned,
)
from diffdrive_mpc.bench.html_report.run_series import column, kept_ticks, run_series
from diffdrive_mpc.bench.html_report.run_warnings import run_warnings
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.documents.screenshots import screenshot

QUICK = ("--plant", "model:ssm", "--surface", "ideal", "--sensors", "perfect", "--trajectory", "cane")
READ = (
    "Object.fromEntries([...document.querySelectorAll('#readout div')]"
    ".map((one) => [one.dataset.name, one.lastChild.textContent]))"
)
HOSTILE = '<script>document.title = "taken"</script><b>&amp;'


@pytest.fixture(scope="module")
def outcome() -> RunOutcome:
    return quick_outcome(trajectory="cane")


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return called(tmp_path_factory.mktemp("single"), "simulate", *QUICK)


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    words = (
        "--quick",
        "--models",
        "ssm,sm",
        "--seeds",
        "2",
        *(word.replace("--trajectory", "--trajectories") for word in QUICK),
    )
    return called(tmp_path_factory.mktemp("compared"), "bench", *words)


def called(folder: Path, *words: str) -> Path:
    invoke(app, *words, "--out", folder)
    return folder / "report.html"


def values(run: dict[str, Any], name: str) -> np.ndarray:
    of = run["columns"][name]
    return np.array([np.nan if one is None else one * of["s"] for one in of["v"]])


def at(page: Any, plot: str, right: float, down: float) -> dict[str, str]:
    """What the readout says with the pointer at a place of a plot, in shares of its size."""
    box = page.locator(plot).bounding_box()
    page.mouse.move(box["x"] + right * box["width"], box["y"] + down * box["height"])
    read: dict[str, str] = page.evaluate(READ)
    return read


@pytest.mark.system("browser")
def test_pointing_at_one_view_marks_the_same_time_in_the_other(single: Path) -> None:
    with opened(single) as page:
        early, late = at(page, "#times", 0.3, 0.1), at(page, "#times", 0.7, 0.1)
        assert float(early["time"].split()[0]) < float(late["time"].split()[0])
        assert {"lateral", "v command", "solver path", "mode", "step time"} <= set(late)
        run = content_of(single)["views"][0]["runs"][0]
        k = int(np.argmin(np.abs(values(run, "t") - float(late["time"].split()[0]))))
        assert float(late["lateral"].split()[0]) == pytest.approx(values(run, "lateral")[k], abs=0.051)
        # The robot drawn in the plane stands where the run was at that time; pointing there gives that time again.
        place = page.evaluate("document.querySelector('#plane .cursor path').getAttribute('transform')")
        x, y = (float(one) for one in place.split("(")[1].split(")")[0].split())
        box = page.locator("#plane").bounding_box()
        again = at(page, "#plane", x / box["width"], y / box["height"])
        assert float(again["time"].split()[0]) == pytest.approx(float(late["time"].split()[0]), abs=0.5)
        marker = page.evaluate("Number(document.querySelector('#times .cursor line').getAttribute('x1'))")
        assert marker == pytest.approx(0.7 * page.locator("#times").bounding_box()["width"], abs=25)
        assert page.locator("#plane .cursor polyline").count() == 1  # the plan
        page.locator("#time").fill("0")
        assert page.evaluate(READ)["time"] == "0.00 s"
        check_page(page)


@pytest.mark.system("browser")
def test_toggles_hide_a_controller_and_its_seeds_in_all_views_at_once(compared: Path) -> None:
    drawn = "(id) => document.querySelector(id).data.length"
    shown_bars = "[...document.querySelectorAll('.charts .plot')].map((one) => one.data.map((trace) => trace.name))"
    with opened(compared) as page:
        assert all("SM" in names for names in page.evaluate(shown_bars))
        before = [page.evaluate(drawn, one) for one in ("#plane", "#times")]
        page.locator("input[data-value='SM']").uncheck()
        assert all(page.evaluate(drawn, one) < count for one, count in zip(("#plane", "#times"), before, strict=True))
        assert not any("SM" in names for names in page.evaluate(shown_bars))
        page.locator("input[data-value='SM']").check()
        page.locator("input[data-toggle='seed'][data-value='1']").focus()
        page.keyboard.press("Space")
        assert page.evaluate(drawn, "#plane") > before[0]
        run = at(page, "#times", 0.5, 0.1)["run"]
        assert run.split(", ")[0] in ("SSM", "SM")
        check_page(page)


def test_a_page_says_how_to_repeat_it_and_with_which_configuration(single: Path) -> None:
    content = content_of(single)
    assert content["origin"]["command"].startswith("diffdrive-mpc simulate --plant model:ssm --surface ideal")
    facts = dict(content["origin"]["facts"])
    assert facts["seed"] == "0"
    assert facts["version"].startswith("diffdrive-mpc")
    assert "horizon: 30" in content["configurations"][0]["text"]


def test_the_same_run_gives_the_same_page_but_for_times(outcome: RunOutcome) -> None:
    def text() -> str:
        runs = RunViews([run_series(outcome.run.with_step_time(np.zeros(len(outcome.run.time))), "a", points=100)])
        return page_text(Page("c", "t", Shown(views=[runs]), [], Origin("c", [])))

    assert text() == text()


@pytest.mark.system("browser")
def test_every_kind_of_view_is_drawn_and_names_from_files_are_text(tmp_path: Path, outcome: RunOutcome) -> None:
    name = HOSTILE
    labels = {"controller": name, "path": "p"}
    series = [Series(name, [1.0, 2.0], [1.0, None], text=[name, name], labels=labels)]
    series += [Series(f"{name}2", [1.0, 2.0], [2.0, 3.0], 1, "bars")]
    axis = GridAxis(name, [1.0, 2.0])
    views = [
        RunViews([run_series(outcome.run, name, points=50, labels=labels)], name),
        Chart(name, Axis(name), Axis(name, "log"), series, name),
        GridMap(name, axis, axis, [[1.0, None], [2.0, 3.0]], name, [[True, False], [False, False]]),
    ]
    shown = Shown(
        [name], [name], [KeyFigure(name, name, name)], [Toggle("controller", (name,), (name,), styled=True)], views,
        [Warned(name, name)], [ConfigurationView(name, name)],
    )  # fmt: skip
    table = Table(name, (name, "b [m]"), ((name, "1"),), note=name)
    path = tmp_path / "report.html"
    path.write_text(page_text(Page(name, name, shown, [table], Origin(name, [(name, name)]))), encoding="utf-8")
    check_report(path)
    with opened(path) as page:
        assert page.title() == name
        assert page.locator("#title").inner_text() == name
        assert page.locator("main script, main b:not(svg b)").count() == 0
        drawn = page.evaluate("[...document.querySelectorAll('.charts .plot text')].map((one) => one.textContent)")
        assert name in drawn


@pytest.mark.system("browser")
def test_a_report_of_tables_alone_needs_no_views(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    table = Table("Costs", ("what", "ms"), (("a", "1"),))
    path.write_text(page_text(Page("c", "t", Shown(), [table], Origin("c", []))), encoding="utf-8")
    with opened(path) as page:
        assert page.locator("td").all_inner_texts() == ["a", "1"]
        assert page.locator("#views").count() == 0
        assert "None" in page.locator("#warnings").inner_text()


def test_content_cannot_end_its_script() -> None:
    assert "<" not in json_text({"a": "</script><!--"})


def test_thinned_runs_keep_their_peaks_and_rounded_columns_their_values(outcome: RunOutcome) -> None:
    run = outcome.run
    kept = kept_ticks(run, 60)
    assert len(kept) == 60
    assert (np.diff(kept) > 0).all()
    assert run.errors.position[kept].max() == run.errors.position.max()
    series = run_series(run, "a", points=60)
    assert values(series, "x") == pytest.approx(run.true_pose[kept, 0], abs=5.1e-4)
    assert values(series, "lateral") == pytest.approx(1e3 * run.errors.lateral[kept], abs=0.051)
    assert np.isnan(values({"columns": {"a": column(np.array([np.nan, 1.0]), 0.1)}}, "a")[0])
    offset = np.hypot(values(series, "along"), 1e3 * 0.0)
    assert (offset <= 1e3 * run.errors.position[kept] + 0.1).all()


def test_spans_of_modes_cover_the_run(outcome: RunOutcome) -> None:
    spans: dict[str, list[tuple[float, float]]] = run_series(outcome.run, "a", points=60)["modes"]  # type: ignore[assignment]
    covered = sum(end - begin for times in spans.values() for begin, end in times)
    assert covered == pytest.approx(outcome.run.time[-1], abs=0.01)


def test_a_sound_run_is_not_warned_of(outcome: RunOutcome) -> None:
    quiet = outcome.run.with_step_time(np.full(len(outcome.run.time), 1e-3))
    assert run_warnings(quiet, case_config(outcome.case)) == []


def test_what_needs_attention_is_said_with_what_to_do(outcome: RunOutcome) -> None:
    run, config = outcome.run, case_config(outcome.case)
    assert config is not None
    count = len(run.time)
    modes = ("BRAKING",) * 4 + ("REUSED_PLAN",) * 2 + run.modes[6:]
    times = np.where(np.arange(count) == 7, 1.0, 1e-3)
    blind = tuple(
        replace(one, pose=None) if count // 3 < k < 2 * count // 3 else one for k, one in enumerate(run.measurements)
    )
    fast = np.full((count, 2), [config.limits.v, 0.0])
    away = replace(
        run, modes=modes, measurements=blind, command=fast, ended="it was lost", messages=("why",) * count,
        true_pose=run.true_pose + 9.0, solver_methods=("osqp",) * count,
    )  # fmt: skip
    found = run_warnings(away.with_step_time(times), config, "SSM")
    told = " ".join(one.what for one in found)
    for said in (
        "it was lost",
        "BRAKING at 4 ticks",
        "REUSED_PLAN at 2 ticks",
        "1 tick took longer",
        "Poses failed to come once",
    ):
        assert said in told
    assert "v at 100 %" in told
    assert "A backend had to solve 100 %" in told
    assert "“why”" in told
    assert all(one.what.startswith("SSM: ") and one.remedy for one in found)


@pytest.mark.system("browser")
def test_a_screenshot_is_small(single: Path, tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    screenshot(single, picture)
    assert 10_000 < picture.stat().st_size < 300_000


def test_a_missing_browser_and_a_missing_report_are_named(tmp_path: Path) -> None:
    missing = pytest.raises(ConfigError, match="no browser: no-such-browser was not found; install chromium")
    with missing, opened_browser("no-such-browser"):
        pass
    with pytest.raises(ConfigError, match="no such report"):
        screenshot(tmp_path / "none.html", tmp_path / "a.png")
