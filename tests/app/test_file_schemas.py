"""JSON Schemas equal those of the readers, and every shipped file satisfies its schema."""

import json
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from commands import invoke
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.schemas import SCHEMAS, json_schema
from diffdrive_mpc.models.checked_yaml import read_yaml
from file_kinds import KINDS

FILES = [(name, path) for name in SCHEMAS for path in KINDS[name].files]
IDS = [f"{name}-{path.stem}" for name, path in FILES]


def validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads(SCHEMAS[kind].read_text(encoding="utf-8")))


@pytest.mark.parametrize("kind", SCHEMAS)
def test_shipped_schema_equals_schema_of_reader(kind: str) -> None:
    """Run `make schemas` if this fails."""
    text = SCHEMAS[kind].read_text(encoding="utf-8")
    Draft202012Validator.check_schema(json.loads(text))
    assert text == json_schema(kind)


@pytest.mark.parametrize(("kind", "path"), FILES, ids=IDS)
def test_shipped_file_satisfies_its_schema(kind: str, path: Path) -> None:
    assert [error.message for error in validator(kind).iter_errors(read_yaml(path))] == []


def test_yaml_numbers_are_read_as_editors_read_them(tmp_path: Path) -> None:
    """1e-3 is a number, as in YAML 1.2 and JSON."""
    path = tmp_path / "numbers.yaml"
    path.write_text("a: 1e-3\nb: -2.5E+2\nc: .5e1\nd: 1e\ne: e5\nf: '1e-3'\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1e-3, "b": -250.0, "c": 5.0, "d": "1e", "e": "e5", "f": "1e-3"}


def test_config_schema_prints_and_writes_a_json_schema(tmp_path: Path) -> None:
    output = invoke(app, "config", "schema", "trajectory", "--json").stdout
    assert output == SCHEMAS["trajectory"].read_text(encoding="utf-8")
    file = tmp_path / "new" / "trajectory.schema.json"
    invoke(app, "config", "schema", "trajectory", "--json", "--out", file)
    assert file.read_text(encoding="utf-8") == output
