"""The report of the tracking study, from rows that were made up and from runs that were driven."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tracking_parts import made_up, tiny_study, write_made_up

from commands import invoke
from diffdrive_mpc.bench.report_folder import CONTENTS
from diffdrive_mpc.models.checked_yaml import ConfigError
from studies.cli import app
from studies.documents.documents import TRACKING, copy_report, sections, with_report
from studies.tracking.study import TrackingStudy, load_study


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_made_up(made_up(), folder)
    return folder


def tables(results=None):
    shown = TrackingStudy(load_study(quick=True)).tables(made_up() if results is None else results)
    return {table.title: table for table in shown}


def test_every_part_has_its_tables_and_every_cell_is_filled():
    assert list(tables()) == [
        "Targets",
        "Default surface and sensors",
        "Ablation",
        "Ablation by trajectory",
        "Cross table",
        "Surfaces and sensors",
        "Scenarios",
        "Bound",
    ]
    for table in tables().values():
        assert table.rows
        assert all(cell for cells in table.rows for cell in cells)


def test_the_diagonal_of_the_cross_table_is_marked():
    table = tables()["Cross table"]
    marked = {
        (cells[0], column)
        for cells in table.rows
        for column, cell in zip(table.columns, cells, strict=True)
        if "*" in cell
    }
    assert marked == {("SM", "plant model:sm [mm]"), ("SSM", "plant model:ssm [mm]")}
    assert "proves little" in table.note


def test_what_is_left_is_ours_minus_the_bound():
    table = tables()["Bound"]
    assert [cells[1] for cells in table.rows] == ["s", "cane", "mean"]
    for cells in table.rows:
        assert (cells[2], cells[-2], cells[-1]) == ("2.0", "8.0", "6.0")


def test_the_ablation_has_every_variant_and_the_bound_on_every_surface():
    variants = list(load_study(quick=True).variants)
    assert [cells[1] for cells in tables()["Ablation"].rows] == [*variants, "clairvoyant bound"]
    assert [cells[1] for cells in tables()["Ablation by trajectory"].rows] == variants


def test_a_variant_is_told_by_its_values():
    """Each variant gets an error of its own; the table must give it back under the right name."""
    study = load_study(quick=True)
    own = {name: 0.010 + 0.001 * k for k, name in enumerate(study.variants)}
    rows = made_up()
    rows = rows.assign(position_rmse_m=rows["variant"].map(own).fillna(rows["position_rmse_m"]))
    found = {cells[1]: float(cells[3]) for cells in tables(rows)["Ablation"].rows}
    assert found == pytest.approx({name: 1e3 * error for name, error in own.items()} | {"clairvoyant bound": 2.0})


def test_the_report_has_figures_and_every_run_once(report: Path):
    data = json.loads((report / "tracking.json").read_text())
    assert len(data["runs"]) == made_up()["case"].nunique()
    assert data["meta"]["revision"] == "abc"
    text = (report / "tracking.md").read_text()
    for name in ("ablation.png", "error-sources.png"):
        assert (report / "figures" / name).stat().st_size > 20_000
        assert f"](figures/{name})" in text


def test_figures_are_the_same_for_the_same_rows(report: Path, tmp_path: Path):
    write_made_up(made_up(), tmp_path)
    for name in ("ablation.png", "error-sources.png"):
        assert (tmp_path / "figures" / name).read_bytes() == (report / "figures" / name).read_bytes()


PAGE = """# Page
<!-- tracking-runs:begin -->
<!-- tracking-runs:end -->
between
<!-- tracking-figure-ablation:begin -->
<!-- tracking-figure-ablation:end -->
<!-- tracking-cross-table:begin -->
old
<!-- tracking-cross-table:end -->
after
"""


def test_the_page_shows_every_part_of_the_report_between_its_markers(report: Path, tmp_path: Path):
    copy_report(TRACKING, report, tmp_path / "tracking")
    text = (tmp_path / "tracking" / "tracking.md").read_text()
    page = with_report(TRACKING, PAGE, text)
    assert "![ablation](tracking/ablation.png)" in page
    assert "| SM | 8.0* | 8.0 |" in page
    assert "old" not in page
    assert "\nbetween\n" in page and page.endswith("\nafter\n")
    assert with_report(TRACKING, page, text) == page
    assert {path.name for path in (tmp_path / "tracking").iterdir()} == {
        "tracking.md",
        "ablation.png",
        "error-sources.png",
    }


def test_parts_that_were_not_run_say_so_and_their_figures_go(report: Path, tmp_path: Path):
    copy_report(TRACKING, report, tmp_path / "tracking")
    results = made_up()
    part = results[results["part"] == "bound"]
    (tmp_path / "out").mkdir()
    write_made_up(part, tmp_path / "out")
    copy_report(TRACKING, tmp_path / "out", tmp_path / "tracking")
    text = (tmp_path / "tracking" / "tracking.md").read_text()
    assert set(sections(TRACKING, text)) == {"tracking-runs", "tracking-bound"}
    page = with_report(TRACKING, PAGE, text)
    assert page.count("This part was not run.") == 2
    assert [path.name for path in (tmp_path / "tracking").iterdir()] == ["tracking.md"]


def test_without_a_report_nothing_is_copied(tmp_path: Path):
    with pytest.raises(ConfigError, match="run `make study NAME=tracking` first"):
        copy_report(TRACKING, tmp_path, tmp_path / "docs")


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a small study, and what the command printed."""
    folder = tmp_path_factory.mktemp("driven")
    words = ["--study", str(tiny_study(folder)), "--only", "ablation,cross,bound", "--jobs", "1"]
    result = invoke(app, "tracking", "--out", folder / "out", *words)
    return folder / "out", result.stdout


def test_the_command_drives_a_small_study_and_writes_its_report(driven: tuple[Path, str]):
    out, printed = driven
    assert sorted(path.name for path in out.iterdir() if path.name != CONTENTS) == [
        "figures",
        "report.html",
        "tracking.json",
        "tracking.md",
    ]
    runs = json.loads((out / "tracking.json").read_text())["runs"]
    assert len(runs) == 4 + 2 + 1
    assert all(run["completed"] for run in runs)
    error = {(run["controller"], run["plant"], bool(run["set"])): run["position_rmse_m"] for run in runs}
    assert error["clairvoyant", "mujoco", False] < error["mpc", "mujoco", False] < error["mpc", "mujoco", True]
    assert "Cross table" in printed
