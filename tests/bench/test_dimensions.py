"""One table of dimensions, from which options, settings, cases and rows follow."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from bench_parts import quick_outcome
from bench_parts import rows as rows_of
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import DIMENSIONS, Case, Dimension, combinations
from diffdrive_mpc.bench.comparison.plan import default_settings, read_options
from diffdrive_mpc.bench.comparison.results import ComparisonResults
from diffdrive_mpc.bench.comparison.tables import path_table
from diffdrive_mpc.bench.controllers import check_cases, load_reference
from diffdrive_mpc.bench.run_row import driver_names
from diffdrive_mpc.models.checked_yaml import ConfigError

NAMES = ["controller", "model", "trajectory", "timing", "plant", "surface", "sensors", "scenario", "seed"]


def test_the_dimensions_are_the_fields_of_a_case() -> None:
    assert [one.name for one in DIMENSIONS] == NAMES
    assert list(Case().as_row()) == NAMES


@pytest.mark.parametrize("of", DIMENSIONS, ids=lambda of: of.name)
def test_every_dimension_has_its_options_and_its_default(of: Dimension) -> None:
    options = {command: set(re.findall(r"--[\w-]+", help_of(command))) for command in ("simulate", "bench")}
    assert of.option in options["simulate"]
    assert of.list_option in options["bench"]
    assert default_settings().values(of.several) == of.compared
    assert getattr(Case(), of.name) == of.default


def help_of(command: str) -> str:
    return CliRunner().invoke(app, [command, "--help"]).stdout


@pytest.mark.parametrize("of", DIMENSIONS, ids=lambda of: of.name)
def test_an_option_chooses_its_values(of: Dimension) -> None:
    text = {"controller": "mpc,kanayama", "seed": "3,7"}.get(of.name, "a,b")
    chosen = read_options({of.several: text}).values(of.several)
    assert [str(value) for value in chosen] == text.split(",")




def test_combinations_vary_the_last_field_fastest() -> None:
    cases = combinations(surface=["default", "slippery"], seed=[0, 1])
    assert [(case.surface, case.seed) for case in cases] == [
        ("default", 0),
        ("default", 1),
        ("slippery", 0),
        ("slippery", 1),
    ]
    assert {case.plant for case in cases} == {"mujoco"}


def test_timing_makes_another_reference_of_a_trajectory() -> None:
    filed, stopping, commanded = (
        load_reference(Case(trajectory="slalom", timing=timing)) for timing in ("file", "stop", "commanded")
    )
    assert commanded.duration < filed.duration < stopping.duration
    with pytest.raises(ConfigError, match="timing 'fast': give stop, commanded or smooth"):
        check_cases([Case(), Case(timing="fast")])


def test_rows_and_tables_tell_of_timing_and_smoothing_only_where_they_matter() -> None:
    plain, smooth = quick_outcome(trajectory="cane"), quick_outcome(trajectory="cane", timing="smooth")
    silent = default_settings()
    rows = ComparisonResults(silent, rows_of(plain)).rows()
    assert not {"timing", "drawn_max_m"} & set(rows[0])
    assert "drawn" not in path_table(rows_of(plain)).markdown()
    asked = silent.model_copy(update={"timings": ("file", "smooth")})
    rows = ComparisonResults(asked, rows_of(plain, smooth)).rows()
    assert [row["timing"] for row in rows] == ["file", "smooth"]
    assert rows[0]["drawn_max_m"] == 0.0
    assert 0.005 < rows[1]["drawn_rms_m"] * 2 < rows[1]["drawn_max_m"] * 2 <= 0.04
    text = path_table(rows_of(plain, smooth)).markdown()
    assert "reference to drawn path, max [m]" in text
    assert "SSM, smooth" in text
