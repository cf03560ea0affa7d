"""The tracking study: plan, rows, targets and report, from artificial rows and simulated runs."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle
from hypothesis import given
from hypothesis import strategies as st
from tracking_parts import TINY, artificial_results, case, recovery, row, tiny_study, write_artificial_report

from commands import invoke
from diffdrive_mpc import ConfigError
from diffdrive_mpc.bench.experiment import frame
from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.bench.report_folder import CONTENTS
from diffdrive_mpc.sim import simulate
from refusals import one_line_error
from studies.cli import app
from studies.tracking.measured import additional_columns, decompose
from studies.tracking.study import TrackingStudy, evaluate_targets, load_study, target_table


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("variant: [as shipped, no", "variant: [long sight, no", "there is no 'long sight'; known: as shipped"),
        (
            "compensation.side_slip: false",
            "compensation.side_slop: false",
            "unknown key 'expert.compensation.side_slop'",
        ),
    ],
)
def test_mistake_in_a_study_gives_one_line_before_any_drive(old: str, new: str, message: str, tmp_path: Path):
    assert old in TINY
    (tmp_path / "mine.yaml").write_text(TINY.replace(old, new, 1))
    with one_line_error(ConfigError, message):
        TrackingStudy(load_study(tmp_path / "mine.yaml")).plan()


@pytest.fixture(scope="module")
def run():
    """Run that starts 0.2 m to the left of an arc and returns to it."""
    return simulate(make_peer("kanayama"), DisplacedUnicycle([0.0, 0.2, 0.0]), Arc(duration=8.0))


def test_along_and_across_are_the_position_error_in_the_frame_of_the_reference(run):
    series = additional_columns(case(surface="slippery"), run)
    assert np.hypot(series["along"], series["across"]) == pytest.approx(run.errors.position[run.counted])
    assert (series["along"][0], series["across"][0]) == pytest.approx((0.0, 0.2))
    assert len(series["time"]) == run.metrics.steps


def test_repeated_error_is_bias_in_the_arc_and_transient_outside_and_noise_is_neither():
    wave = 0.002 * (-1.0) ** np.arange(100)
    steady = np.arange(100) >= 50
    bias, entry = np.where(steady, 0.003, 0.0), np.where(steady, 0.0, 0.005)
    rows = [row(case(seed=seed), across=bias + entry + sign * wave) for seed, sign in ((20, 1), (21, -1))]
    parts = decompose(frame(rows))
    # The unbiased variance of two opposite values is twice their square.
    assert parts.noise == pytest.approx(2 * 0.002**2)
    assert parts.bias == pytest.approx(0.5 * (0.003**2 - 0.002**2))
    assert parts.transient == pytest.approx(0.5 * (0.005**2 - 0.002**2))
    assert parts.along == 0.0


@given(st.integers(1, 6), st.integers(0, 1000))
def test_parts_add_up_to_the_mean_square_for_any_errors(seeds, key):
    random = np.random.default_rng(key)
    rows = [row(case(seed=k), across=random.normal(size=100), along=random.normal(size=100)) for k in range(seeds)]
    total = np.mean([parts["across"] ** 2 + parts["along"] ** 2 for parts in rows])
    assert decompose(frame(rows)).total == pytest.approx(total)


STUDY = load_study(quick=True)
CASES = [drive.case for drive in STUDY.drives(["targets"])["targets"]]


def verdicts(change=lambda case: {}):
    return {(v.quantity, v.where): v for v in evaluate_targets(frame(row(case, **change(case)) for case in CASES))}


def cases_with(**conditions):
    """Return a predicate that is true for cases that meet the conditions."""
    return lambda case: all(getattr(case, name) == value for name, value in conditions.items())


PLAIN = {"scenario": "none", "sensors": "default"}


@pytest.mark.parametrize(
    ("where", "changes", "claim", "place"),
    [
        ({**PLAIN, "surface": "default"}, {"position_rmse_m": 0.0061}, "position RMSE [m]", "default"),
        ({**PLAIN, "surface": "default"}, {"arcs": (0.001, -0.0031)}, "lateral error of the worst arc [m]", "default"),
        (
            {**PLAIN, "surface": "slippery", "trajectory": "s"},
            {"late_lateral_m": 0.051},
            "largest lateral after 2 s [m]",
            "slippery",
        ),
        ({"sensors": "slam", "trajectory": "s"}, {"completed": False}, "runs not completed", "slam sensors"),
        (
            {"scenario": "false_command", "trajectory": "s"},
            recovery(1.0, 0.051, 1.0, 1.0),
            "largest overshoot [m]",
            "false_command",
        ),
        (
            {"scenario": "false_command", "trajectory": "s"},
            recovery(math.inf, math.nan, 1.0, 1.0),
            "longest recovery [s]",
            "false_command",
        ),
    ],
)
def test_model_beyond_a_limit_fails_only_its_own_target(where, changes, claim, place):
    results = verdicts(lambda case: changes if cases_with(model="sm", **where)(case) else {})
    verdict = results[claim, place]
    assert not verdict.met
    assert not verdict.met_by("SM")
    assert verdict.met_by("SSM")
    others = {key for key, result in results.items() if not result.met} - {(claim, place)}
    assert others <= {("position RMSE [m], the aim", "default"), ("largest overshoot [m]", place)}
    (cells,) = target_table([verdict]).rows
    sm, ssm = cells[3:5]
    assert "(no)" in sm
    assert "(no)" not in ssm
    assert cells[-1] == "no"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    write_artificial_report(artificial_results(), folder)
    return folder


def tables(results=None):
    shown = TrackingStudy(load_study(quick=True)).tables(artificial_results() if results is None else results)
    return {table.title: table for table in shown}


def test_variants_are_distinguished_by_their_values():
    """Each variant has a different error; the table must show it under the correct name."""
    study = load_study(quick=True)
    errors = {name: 0.010 + 0.001 * k for k, name in enumerate(study.variants)}
    rows = artificial_results()
    rows = rows.assign(position_rmse_m=rows["variant"].map(errors).fillna(rows["position_rmse_m"]))
    ablation = {cells[1]: float(cells[3]) for cells in tables(rows)["Ablation"].rows}
    assert ablation == pytest.approx({name: 1e3 * error for name, error in errors.items()} | {"clairvoyant bound": 2.0})


def test_report_has_figures_and_every_run_once(report: Path):
    data = json.loads((report / "tracking.json").read_text())
    assert len(data["runs"]) == artificial_results()["case"].nunique()
    assert data["meta"]["revision"] == "abc"
    text = (report / "tracking.md").read_text()
    for name in ("ablation.png", "error-sources.png"):
        assert (report / "figures" / name).stat().st_size > 20_000
        assert f"](figures/{name})" in text


@pytest.fixture(scope="module")
def small_study(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a small study, and the output of the command."""
    folder = tmp_path_factory.mktemp("driven")
    words = ["--study", str(tiny_study(folder)), "--only", "ablation,cross,bound", "--jobs", "1"]
    result = invoke(app, "tracking", "--out", folder / "out", *words)
    return folder / "out", result.stdout


def test_command_runs_a_small_study_and_writes_its_report(small_study: tuple[Path, str]):
    out, output = small_study
    files = {"figures", "report.html", "tracking.json", "tracking.md", CONTENTS}
    assert {path.name for path in out.iterdir()} == files
    runs = json.loads((out / "tracking.json").read_text())["runs"]
    assert len(runs) == 4 + 2 + 1
    assert all(run["completed"] for run in runs)
    error = {(run["controller"], run["plant"], bool(run["set"])): run["position_rmse_m"] for run in runs}
    assert error["clairvoyant", "mujoco", False] < error["mpc", "mujoco", False] < error["mpc", "mujoco", True]
    assert "Cross table" in output
