"""JSON Schemas accept and refuse the same files as the readers, within what a schema can state."""

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from pydantic import ValidationError

from commands import invoke
from diffdrive_mpc import ModelError, load_config, load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.schemas import SCHEMAS, json_schema
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.load import load_model, model_path
from file_kinds import KINDS

READERS: dict[str, Callable[[Path], object]] = {
    "controller": load_config,
    "trajectory": load_trajectory,
    "model": load_model,
}
BEYOND_A_SCHEMA = ("value_error", "finite_number")
"""Error types that involve several keys, which a schema cannot state."""
FILES = [(name, path) for name in SCHEMAS for path in KINDS[name].files]
IDS = [f"{name}-{path.stem}" for name, path in FILES]


def validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads(SCHEMAS[kind].read_text(encoding="utf-8")))


def reader_error(kind: str, data: object, folder: Path) -> str | None:
    """Return None if accepted, "structure" for errors that a schema can state, "meaning" for others."""
    path = folder / "changed.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    try:
        READERS[kind](path)
    except ModelError:
        return "meaning"
    except ConfigError as error:
        cause: BaseException | None = error.__cause__
        while isinstance(cause, ConfigError):
            cause = cause.__cause__
        if not isinstance(cause, ValidationError):
            return "structure" if "structure: expected one of" in str(error) else "meaning"
        return "meaning" if all(mistake["type"] in BEYOND_A_SCHEMA for mistake in cause.errors()) else "structure"
    return None


def changes(data: Any, node: Any) -> Iterator[tuple[str, Any]]:
    """Yield copies of `data` with one mistake each, in the keys of `node`, a part of it."""
    items = list(node.items()) if isinstance(node, dict) else list(enumerate(node))[:1]  # one item represents the list
    if isinstance(node, dict):
        node["no_such_key"] = 1.0
        yield "a key too many", copy.deepcopy(data)
        del node["no_such_key"]
    for key, value in items:
        for label, wrong in (("a word", "x"), ("a list", [["x"]]), ("a group", {"x": {}}), ("negative", -1e9)):
            node[key] = wrong
            yield f"{key}: {label}", copy.deepcopy(data)
        node[key] = value
        if isinstance(node, dict):
            del node[key]
            yield f"{key}: missing", copy.deepcopy(data)
            node[key] = value
        if isinstance(value, (dict, list)):
            yield from changes(data, value)


@pytest.mark.parametrize("kind", SCHEMAS)
def test_shipped_schema_equals_schema_of_reader(kind: str) -> None:
    """Run `make schemas` if this fails."""
    text = SCHEMAS[kind].read_text(encoding="utf-8")
    Draft202012Validator.check_schema(json.loads(text))
    assert text == json_schema(kind)


@pytest.mark.parametrize(("kind", "path"), FILES, ids=IDS)
def test_shipped_file_fits_its_schema(kind: str, path: Path) -> None:
    assert [error.message for error in validator(kind).iter_errors(read_yaml(path))] == []


EXAMPLES = [(kind, max(KINDS[kind].files, key=lambda path: path.stat().st_size)) for kind in SCHEMAS]
EXAMPLES += [("model", model_path(name)) for name in ("mbm", "lstm", "p2_physical")]


@pytest.mark.parametrize(("kind", "path"), EXAMPLES, ids=[f"{kind}-{path.stem}" for kind, path in EXAMPLES])
def test_schema_and_reader_refuse_the_same_mistakes(kind: str, path: Path, tmp_path: Path) -> None:
    agree(kind, read_yaml(path), tmp_path)


def agree(kind: str, data: Any, folder: Path) -> None:
    fits = validator(kind).is_valid
    assert fits(data)
    disagree = []
    every = list(changes(data, data))
    for label, changed in every[:: 1 + len(every) // 120]:
        refused = reader_error(kind, changed, folder)
        if (refused == "structure") == fits(changed) and refused != "meaning":
            disagree.append((label, refused))
    assert disagree == []


def test_yaml_numbers_are_read_as_editors_read_them(tmp_path: Path) -> None:
    """1e-3 is a number, as in YAML 1.2 and JSON."""
    path = tmp_path / "numbers.yaml"
    path.write_text("a: 1e-3\nb: -2.5E+2\nc: .5e1\nd: 1e\ne: e5\nf: '1e-3'\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1e-3, "b": -250.0, "c": 5.0, "d": "1e", "e": "e5", "f": "1e-3"}


def test_config_schema_prints_and_writes_a_json_schema(tmp_path: Path) -> None:
    printed = invoke(app, "config", "schema", "trajectory", "--json").stdout
    assert printed == SCHEMAS["trajectory"].read_text(encoding="utf-8")
    file = tmp_path / "new" / "trajectory.schema.json"
    invoke(app, "config", "schema", "trajectory", "--json", "--out", file)
    assert file.read_text(encoding="utf-8") == printed
