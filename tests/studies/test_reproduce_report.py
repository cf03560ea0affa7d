"""The report of `reproduce`, from results that were made up, and the command."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from reproduce_parts import made_up, report_of, write_made_up

from commands import invoke
from diffdrive_mpc.bench.report_folder import CONTENTS
from studies.cli import app
from studies.documents.documents import REPRODUCE, sections

FIGURES = (
    *("odometry.png", "orders.png", "virtual-track.png", "slip-scatter.png"),
    *("turn-torques.png", "turn-power.png", "turn-learning.png", "turn-energy.png"),
)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_made_up(made_up(), folder)
    return folder


def test_every_table_is_filled_and_published_numbers_stand_beside_ours():
    tables = {table.title: table for table in report_of(made_up()).tables}
    assert list(tables) == [
        "Findings",
        "FIT of motors and of SM",
        "Position errors of open-loop odometry",
        "Heading errors of open-loop odometry",
        "SSM by order",
        "SSM velocity on free drives",
        "SSM odometry on free drives",
        "SSM velocity on fast free drives",
        "SSM odometry on fast free drives",
        "The nine networks",
        "SSM and LSTM velocity",
        "SSM and LSTM odometry",
        "Cost of a simulation",
        "Virtual track",
        "Scatter of foreseen poses",
        "Learned terms",
        "Steady turns",
        "Least radius learned",
        "Energy foreseen",
        "Cost of learning",
    ]
    for table in tables.values():
        assert table.rows
        assert all(cell for cells in table.rows for cell in cells)
    assert ("P4, concrete, mean", "-", "-", "-16.8", "42.2") in tables["Energy foreseen"].rows
    assert ("grippy, mean", "-", "-", "-10.0", "33.0") in tables["Energy foreseen"].rows
    assert ("a plan on 10 m by 10 m (SBMPO)", "240", "400") in tables["Cost of learning"].rows
    assert ("P4, grass", "1.11", "-", "1.2", "8.1", "-") in tables["Least radius learned"].rows
    assert ("RMSE", "circle", "0.848", "1.057", "0.079", "0.158", "0.237") in tables[
        "Position errors of open-loop odometry"
    ].rows
    order_5 = tables["SSM by order"].rows[4]
    assert order_5[:5] == ("5", "97.41", "85.23", "0.03", "0.09")
    assert order_5[5:7] == ("97.00", "80.00")


def test_averages_of_the_free_drives_are_the_paper_s():
    tables = {table.title: table for table in report_of(made_up()).tables}
    averages = [cells for cells in tables["SSM odometry on free drives"].rows if cells[1] == "average"]
    assert averages[0][2:6] == ("0.85", "0.67", "0.53", "1.65")
    averages = [cells for cells in tables["SSM velocity on free drives"].rows if cells[1] == "average"]
    assert averages[0][2:4] == ("94.70", "91.71")
    for title, paper in (("SSM and LSTM velocity", ("93.10", "90.95")), ("SSM and LSTM odometry", ("1.09", "0.80"))):
        (average,) = [cells for cells in tables[title].rows if cells[:2] == ("published LSTM", "average")]
        assert average[2:4] == paper


def test_the_report_has_every_figure_and_the_verdicts(report: Path):
    data = json.loads((report / "reproduce.json").read_text())
    verdicts = {finding["claim"]: finding["verdict"] for finding in data["findings"]}
    assert verdicts["the printed tests give the printed p1 within 2 standard deviations"] == "no"
    assert len(data["mbm_sm"]) == len(data["ssm"]) == 2
    assert "paths" not in data["mbm_sm"][0]
    assert data["learned_turns"][0]["runs"][0] == {"seed": 1, "measured": 100.0, "learned": 110.0, "prior": 67.0}
    text = (report / "reproduce.md").read_text()
    for name in FIGURES:
        assert (report / "figures" / name).stat().st_size > 20_000
        assert f"](figures/{name})" in text


@pytest.mark.long
def test_the_same_results_give_the_same_files(report: Path, tmp_path: Path):
    write_made_up(made_up(), tmp_path)
    for name in ("reproduce.json", "reproduce.md", *(f"figures/{name}" for name in FIGURES)):
        assert (tmp_path / name).read_bytes() == (report / name).read_bytes()


def test_every_table_and_figure_has_its_place_on_the_page(report: Path):
    parts = sections(REPRODUCE, (report / "reproduce.md").read_text())
    page = (Path(__file__).parents[2] / "docs" / "reproduce.md").read_text(encoding="utf-8")
    for name in parts:
        assert f"<!-- {name}:begin -->" in page


def test_parts_that_were_not_run_leave_nothing(tmp_path: Path):
    only = replace(made_up(), mbm_sm=(), ssm=(), lstm=(), rows=(), cost=None, slip_scatter=())
    write_made_up(replace(only, turning=None, learned_turns=()), tmp_path)
    assert [path.name for path in (tmp_path / "figures").iterdir()] == ["virtual-track.png"]
    text = (tmp_path / "reproduce.md").read_text()
    assert [line for line in text.splitlines() if line.startswith("## ")] == ["## Findings", "## Virtual track"]


def test_the_command_writes_its_report(tmp_path: Path):
    out = tmp_path / "out"
    result = invoke(app, "reproduce", "--out", out, "--quick", "--only", "virtual_track")
    assert sorted(path.name for path in out.iterdir() if path.name != CONTENTS) == [
        "figures",
        "report.html",
        "reproduce.json",
        "reproduce.md",
    ]
    assert "-0.022 ± 0.021" in result.stdout
