"""Tracking study: parts of the error, and a small run of the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle
from hypothesis import given
from hypothesis import strategies as st
from pandas import DataFrame

from commands import invoke
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.peers import make_peer
from diffdrive_mpc.bench.report_folder import CONTENTS
from diffdrive_mpc.sim import simulate
from studies.cli import app
from studies.tracking.measured import additional_columns, decompose


def test_along_and_across_are_the_position_error_in_the_frame_of_the_reference():
    """The run starts 0.2 m to the left of an arc and returns to it."""
    run = simulate(make_peer("kanayama"), DisplacedUnicycle([0.0, 0.2, 0.0]), Arc(duration=8.0))
    series = additional_columns(Case(surface="slippery", seed=20), run)
    assert np.hypot(series["along"], series["across"]) == pytest.approx(run.errors.position[run.counted])
    assert (series["along"][0], series["across"][0]) == pytest.approx((0.0, 0.2))
    assert len(series["time"]) == run.metrics.steps


def row(across, along=None):
    """Return a row of 100 ticks whose second half is a steady arc."""
    time = 0.02 * np.arange(100)
    return {"time": time, "across": across, "along": 0 * time if along is None else along, "steady": time >= 1.0}


def test_repeated_error_is_bias_in_the_arc_and_transient_outside_and_noise_is_neither():
    wave = 0.002 * (-1.0) ** np.arange(100)
    repeated = np.where(np.arange(100) >= 50, 0.003, 0.005)
    parts = decompose(DataFrame([row(repeated + wave), row(repeated - wave)]))
    # The unbiased variance of two opposite values is twice their square.
    assert parts.noise == pytest.approx(2 * 0.002**2)
    assert parts.bias == pytest.approx(0.5 * (0.003**2 - 0.002**2))
    assert parts.transient == pytest.approx(0.5 * (0.005**2 - 0.002**2))
    assert parts.along == 0.0


@given(st.integers(1, 6), st.integers(0, 1000))
def test_parts_add_up_to_the_mean_square_for_any_errors(seeds, key):
    rng = np.random.default_rng(key)
    rows = [row(rng.normal(size=100), rng.normal(size=100)) for _ in range(seeds)]
    total = np.mean([parts["across"] ** 2 + parts["along"] ** 2 for parts in rows])
    assert decompose(DataFrame(rows)).total == pytest.approx(total)


SMALL_STUDY = """
title: Tracking
vary: {model: [ssm], trajectory: [cane], seed: [20]}
variants: {as shipped: {}, no side-slip: {compensation.side_slip: false}}
parts:
  targets: [{surface: [default, slippery]}, {sensors: [slam]}]
  ablation: [{variant: [as shipped, no side-slip], seed: [20, 21]}]
  cross: [{plant: ["model:sm", "model:ssm"]}]
  surfaces: [{surface: [default]}]
  scenarios: [{scenario: [none]}]
  bound: [{controller: [clairvoyant], model: [none], sensors: [perfect], seed: [0]}]
"""


@pytest.mark.system
def test_command_runs_a_small_study_and_writes_its_report(tmp_path: Path):
    (tmp_path / "tiny.yaml").write_text(SMALL_STUDY, encoding="utf-8")
    out = tmp_path / "out"
    arguments = ["--study", tmp_path / "tiny.yaml", "--only", "ablation,cross,bound", "--jobs", "1"]
    output = invoke(app, "tracking", "--out", out, *arguments).stdout
    files = {"figures", "report.html", "tracking.json", "tracking.md", CONTENTS}
    assert {path.name for path in out.iterdir()} == files
    runs = json.loads((out / "tracking.json").read_text())["runs"]
    assert len(runs) == 4 + 2 + 1
    assert all(run["completed"] for run in runs)
    error = {(run["controller"], run["plant"], bool(run["set"])): run["position_rmse_m"] for run in runs}
    assert error["clairvoyant", "mujoco", False] < error["mpc", "mujoco", False] < error["mpc", "mujoco", True]
    assert "Cross table" in output
