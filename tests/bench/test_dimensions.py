"""Table of dimensions, which defines options, settings, cases and rows."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import DIMENSIONS, Case, Dimension
from diffdrive_mpc.bench.comparison.plan import default_settings
from diffdrive_mpc.bench.controllers import load_reference
from diffdrive_mpc.mpc.config.typed_settings import parse_setting, parse_single_settings


@pytest.mark.parametrize("dimension", DIMENSIONS, ids=lambda dimension: dimension.name)
def test_every_dimension_has_its_options_and_its_default(dimension: Dimension) -> None:
    options = {command: set(re.findall(r"--[\w-]+", help_of(command))) for command in ("simulate", "bench")}
    assert dimension.option in options["simulate"]
    assert dimension.list_option in options["bench"]
    assert default_settings().values(dimension.plural) == dimension.compared
    assert getattr(Case(), dimension.name) == dimension.default


def help_of(command: str) -> str:
    return CliRunner().invoke(app, [command, "--help"]).stdout


def test_timing_selects_another_reference_of_a_trajectory() -> None:
    from_file, stopping, commanded = (
        load_reference(Case(trajectory="slalom", timing=timing)) for timing in ("file", "stop", "commanded")
    )
    assert commanded.duration < from_file.duration < stopping.duration


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("horizon=5", [5]),
        ("horizon=5,10, 20", [5, 10, 20]),
        ("weights.across=1.5,2", [1.5, 2]),
        ("solver.tolerance=1e-5,1E-4", [1e-5, 1e-4]),
        ("failure.resume=true,false", [True, False]),
        ("extra_dead_time.provenance=step test", ["step test"]),
    ],
)
def test_values_have_their_yaml_types(text: str, values: list[object]) -> None:
    key, parsed = parse_setting(text)
    assert key == text.partition("=")[0]
    assert parsed == values
    assert [type(value) for value in parsed] == [type(value) for value in values]


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=5))
def test_every_finite_number_is_read_exactly(numbers: list[float]) -> None:
    assert parse_setting("key=" + ",".join(repr(number) for number in numbers))[1] == numbers


def test_single_run_has_one_value_for_each_key() -> None:
    assert parse_single_settings(["horizon=5", "weights.along=2"]) == (("horizon", 5), ("weights.along", 2))
