"""Output of the command line: configurations and models, seeds, completion, and widths of tables."""

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import ControllerConfig, load_config, load_model
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.bench.case import parse_seeds
from diffdrive_mpc.mpc.config.described import schema_rows
from diffdrive_mpc.mpc.config.rooms import merge_sections

runner = CliRunner()


def test_shown_configuration_is_a_file_with_the_same_values(tmp_path: Path) -> None:
    result = invoke(app, "config", "show", "ssm")
    path = tmp_path / "mine.yaml"
    path.write_text(result.stdout)
    assert load_config(path) == load_config("ssm")
    assert merge_sections(yaml.safe_load(result.stdout)) == load_config("ssm").model_dump()
    checked = invoke(app, "config", "check", path)
    assert "valid, horizon 30 steps" in checked.stdout


def test_config_check_names_the_violated_limit_and_a_feasible_timing(tmp_path: Path) -> None:
    config, path = tmp_path / "mine.yaml", tmp_path / "arcs.yaml"
    config.write_text("{limits: {omega_slew: 0.8}}")
    arcs = [{"v": 0.6, "omega": omega, "duration": 3.0} for omega in (1.0, -1.0)]
    path.write_text(yaml.safe_dump({"segments": arcs, "timing": "commanded"}))
    lines = invoke(app, "config", "check", config, "--trajectory", path).stdout.splitlines()
    assert "note: default values of the papers' robot: model ssm, sample_time" in lines[1]
    assert "6.0 s in the file, driven in" in lines[2] and "(timing: commanded)" in lines[2]
    assert "'arcs': infeasible from" in lines[3] and "limits.omega_slew = 0.8" in lines[3]
    assert "timing: smooth makes the reference feasible, in" in lines[4]
    assert "reference 'circle': feasible in" in invoke(app, "config", "check", config, "--trajectory", "circle").stdout


def test_schema_lists_every_key_with_its_default() -> None:
    flat = {row.key: row for row in schema_rows()}
    assert flat["horizon"].default == str(ControllerConfig().horizon)
    assert flat["horizon"].range == ">= 1, <= 200"
    assert flat["weights.across"].range == ">= 0"
    assert flat["solver.method"].range == "auto, osqp, daqp"
    text = runner.invoke(app, ["config", "schema"]).stdout
    assert all(key in text for key in flat)
    assert "[" not in flat["weights.across"].help


def test_model_is_shown_with_its_parameters_and_origin() -> None:
    result = invoke(app, "models", "show", "ssm")
    assert "-7.444, -13.25" in result.stdout
    assert "published" in result.stdout
    assert str(load_model("ssm").provenance["source"]).split(":")[0] in result.stdout


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", (0, 1, 2)), ("7,", (7,)), ("3,4", (3, 4)), ("1000000000,", (1_000_000_000,))]
)
def test_seeds_are_parsed_from_a_count_or_a_list(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds
