"""The commands that show, check and explain configurations and models."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import ControllerConfig, load_config, load_model
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.schemas.generate import json_schema
from diffdrive_mpc.mpc.config.described import schema_rows
from diffdrive_mpc.mpc.config.rooms import side_by_side

runner = CliRunner()
ROOT = Path(__file__).parents[2]
SCHEMA = ROOT / "mpc" / "schemas" / "controller.schema.json"


def test_a_shown_configuration_is_a_file_with_the_same_values(tmp_path: Path) -> None:
    shown = invoke(app, "config", "show", "ssm")
    path = tmp_path / "mine.yaml"
    path.write_text(shown.stdout)
    assert load_config(path) == load_config("ssm")
    assert side_by_side(yaml.safe_load(shown.stdout)) == load_config("ssm").model_dump()
    checked = invoke(app, "config", "check", path)
    assert "valid, horizon 30 steps" in checked.stdout


def test_the_schema_lists_every_key_with_its_default() -> None:
    flat = {row.key: row for row in schema_rows()}
    assert flat["horizon"].default == str(ControllerConfig().horizon)
    assert flat["horizon"].range == ">= 1, <= 200"
    assert flat["weights.across"].unit == "1/m^2"
    assert flat["weights.across"].range == ">= 0"
    assert flat["solver.method"].range == "auto, osqp, daqp"
    assert all(row.help for row in flat.values())
    text = runner.invoke(app, ["config", "schema"]).stdout
    assert all(key in text for key in flat)
    assert "[" not in flat["weights.across"].help


@pytest.mark.parametrize("part", ["weights", "limits.v", "solver", "terms"])
def test_a_part_of_the_schema_is_shown_alone(part: str) -> None:
    result = invoke(app, "config", "schema", part)
    shown = [line.split()[0] for line in result.stdout.splitlines()[3:] if not line.startswith(" ")]
    assert shown == [row.key for row in schema_rows() if re.fullmatch(rf"(expert\.)?{part}((\[\])?\..*)?", row.key)]


def test_the_json_schema_is_written_to_a_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "controller.schema.json"
    result = runner.invoke(app, ["config", "schema", "--json", "--out", str(path)])
    assert (result.exit_code, result.stdout) == (0, "")
    assert path.read_text() == json_schema("controller")
    refused = runner.invoke(app, ["config", "schema", "--out", str(tmp_path / "table.txt")])
    assert (refused.exit_code, refused.stderr) == (2, "error: --out is for the JSON schema; give --json too\n")
    assert [entry.name for entry in tmp_path.iterdir()] == ["new"]


def test_every_number_in_the_json_schema_says_what_it_is() -> None:
    groups = json.loads(SCHEMA.read_text(encoding="utf-8"))
    for group in (groups, *groups["$defs"].values()):
        for name, field in group["properties"].items():
            if field.get("type") in ("number", "integer"):
                assert re.search(r"\w.* \[.+\]$", field["description"]), name


def test_a_model_is_shown_with_its_numbers_and_origin() -> None:
    result = invoke(app, "models", "show", "ssm")
    assert "-7.444, -13.25" in result.stdout
    assert "published" in result.stdout
    assert str(load_model("ssm").provenance["source"]).split(":")[0] in result.stdout


def test_a_model_file_is_checked(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "models" / "parameters" / "ssm.yaml"
    path = tmp_path / "good.yaml"
    path.write_text(source.read_text())
    assert "2 states" in runner.invoke(app, ["models", "check", str(path)]).stdout


def test_every_shipped_model_is_listed() -> None:
    assert {"mbm", "sm", "ssm"} <= set(runner.invoke(app, ["models", "list"]).stdout.split())
