"""Findings of the reproduction, and their report."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from reproduce_parts import artificial_results, mbm_sm, report_of, ssm, write_artificial_report

from commands import invoke
from diffdrive_mpc.bench.report_folder import CONTENTS
from studies.cli import app
from studies.documents.documents import REPRODUCE, sections
from studies.reproduce.study import evaluate_findings


def verdicts(results):
    return {finding.claim: finding.verdict for finding in evaluate_findings(results)}


def verdict(results, *words):
    (result,) = [value for claim, value in verdicts(results).items() if all(word in claim for word in words)]
    return result


def test_results_of_the_papers_confirm_their_claims():
    """Artificial results like those of the papers: claims hold unless the papers' tables contradict or omit them."""
    exceptions = {claim: value for claim, value in verdicts(artificial_results()).items() if value != "yes"}
    assert exceptions == {
        "the printed tests result in the printed p1 within 2 standard deviations": "no",
        "tracks exchanged by mistake (tests 1, 2 with 7, 8) explain the printed p1 within 2 standard "
        "deviations": "inconclusive",
    }


def test_comparison_of_models_is_counted_by_repetition():
    results = artificial_results()
    better, worse = mbm_sm(1, mbm=0.1, sm=0.3), mbm_sm(2, mbm=0.4, sm=0.3)
    for pair, expected in (((better, better), "yes"), ((better, worse), "1 of 2"), ((worse, worse), "no")):
        assert verdict(replace(results, mbm_sm=pair), "MBM predicts the position") == expected
        assert verdict(replace(results, mbm_sm=pair), "MBM predicts the heading") == expected


@pytest.mark.parametrize(
    ("omega", "words", "expected"),
    [
        ((0.0, 90.0, 90.1, 90.6, 80.0), "orders 3 and 4 improve", "no"),
        ((0.0, 90.0, 90.1, 90.2, 80.0), "order 4 has the best", "no"),
        ((0.0, 90.0, 90.1, 90.4, 80.0), "order 4 has the best", "yes"),
        ((0.0, 90.0, 90.1, 90.2, 89.999), "order 5 explains omega worse", "no"),
        ((0.0, 90.0, 90.1, 90.2, 89.89), "order 5 explains omega worse", "yes"),
    ],
)
def test_orders_are_judged_by_their_test_fit(omega, words, expected):
    assert verdict(replace(artificial_results(), ssm=(ssm(1, omega=omega),)), words) == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"by_radius_exchanged": 0.9}, "inconclusive"),
        ({"fitting": 1}, "inconclusive"),
        ({"fitting": 1, "by_radius_exchanged": 0.9}, "yes"),
    ],
)
def test_exchange_of_tracks_is_confirmed_only_if_rare_and_supported_by_the_radii(changes, expected):
    results = artificial_results()
    track = replace(results.virtual_track, **changes)
    assert verdict(replace(results, virtual_track=track), "exchanged by mistake") == expected
    not_given = replace(track, fitted_exchanged=track.fitted)
    assert verdict(replace(results, virtual_track=not_given), "exchanged by mistake") == "no"


FIGURES = ("odometry", "error-maps", "responses", "orders", "ssm-steps", "training", "experiment-1", "virtual-track")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_artificial_report(artificial_results(), folder)
    return folder


def test_every_table_is_filled_with_published_and_own_values():
    tables = {table.title: table for table in report_of(artificial_results()).tables}
    for table in tables.values():
        assert table.rows
        assert all(cell for cells in table.rows for cell in cells)
    assert ("RMSE", "circle", "0.848", "1.057", "0.079", "0.158", "0.237") in tables[
        "Position errors of open-loop odometry"
    ].rows
    order_5 = tables["SSM by order"].rows[4]
    assert order_5[:5] == ("5", "97.41", "85.23", "0.03", "0.09")
    assert order_5[5:7] == ("97.00", "80.00")


def test_report_has_every_figure_and_the_verdicts(report: Path):
    data = json.loads((report / "reproduce.json").read_text())
    verdicts = {finding["claim"]: finding["verdict"] for finding in data["findings"]}
    assert verdicts["the printed tests result in the printed p1 within 2 standard deviations"] == "no"
    assert len(data["mbm_sm"]) == len(data["ssm"]) == 2
    assert "paths" not in data["mbm_sm"][0]
    text = (report / "reproduce.md").read_text()
    for name in FIGURES:
        assert (report / "figures" / f"{name}.png").stat().st_size > 20_000
        assert f"](figures/{name}.png)" in text


def test_tables_of_the_page_are_in_the_report(report: Path):
    parts = sections(REPRODUCE, (report / "reproduce.md").read_text())
    page = (Path(__file__).parents[2] / "docs" / "reproduce.md").read_text(encoding="utf-8")
    shown = re.findall(r"<!-- (reproduce-[a-z-]+):begin -->", page)
    assert {"reproduce-runs", "reproduce-findings"} <= set(shown) <= set(parts)


def test_command_writes_its_report(tmp_path: Path):
    out = tmp_path / "out"
    result = invoke(app, "reproduce", "--out", out, "--quick", "--only", "virtual_track")
    files = {"figures", "report.html", "reproduce.json", "reproduce.md", CONTENTS}
    assert {path.name for path in out.iterdir()} == files
    assert "-0.022 ± 0.021" in result.stdout
