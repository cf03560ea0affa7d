"""JSON Schemas say of files what their readers say, as far as a schema can."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator
from pydantic import ValidationError
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import ModelError, load_config, load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.command_line.file_kinds import KINDS
from diffdrive_mpc.app.schemas.generate import json_schema
from diffdrive_mpc.app.tune.tune_file import load_plan
from diffdrive_mpc.bench.spec import load_experiment
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc.models.load import load_model, model_path
from diffdrive_mpc.models.logs.mapping import load_mapping
from diffdrive_mpc.models.named_file import EDITOR_LINE, kept_editor_line
from diffdrive_mpc.models.stated_robot import load_stated_robot
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.campaign.campaign_file import load_campaign
from diffdrive_mpc_extras.campaign.conditions import load_conditions
from diffdrive_mpc_extras.proof.proof_file import load_proof
from diffdrive_mpc_extras.terrain import load_terrain
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_turn_costs, load_vehicle
from diffdrive_mpc_extras.worlds.world_file import load_world
from diffdrive_mpc_monitor.rules import load_rules

ROOT = Path(__file__).parents[2]
READERS: dict[str, Callable[[Path], object]] = {
    "controller": load_config,
    "monitor": load_rules,
    "trajectory": load_trajectory,
    "model": load_model,
    "mapping": load_mapping,
    "stated-robot": load_stated_robot,
    "vehicle": load_vehicle,
    "terrain": load_terrain,
    "drive": load_drive_constants,
    "turn-costs": load_turn_costs,
    "robot": load_simulated_robot,
    "surface": load_surface,
    "sensors": load_sensor_set,
    "scenario": load_scenario,
    "campaign": load_campaign,
    "experiment": load_experiment,
    "proof": load_proof,
    "tune": load_plan,
    "conditions": load_conditions,
    "world": load_world,
}
CAMPAIGN = {
    "description": "a test",
    "runs": 4,
    "factors": {
        "trajectory": {"one_of": ["circle", "s"]},
        "seed": {"each": 0},
        "config.horizon": {"integers": [20, 30]},
        "robot.robot.mass": {"normal": {"mean": 7.0, "sd": 1.0, "low": 5.0}},
        "surface.friction": {"log_uniform": [0.4, 1.0]},
    },
}
BEYOND_A_SCHEMA = ("value_error", "finite_number")
"""Faults between keys, which readers find and a schema cannot state."""
FILES = [(name, path) for name, kind in KINDS.items() for path in kind.files]
IDS = [f"{name}-{path.stem}" for name, path in FILES]


def validator(kind: str) -> Draft202012Validator:
    return Draft202012Validator(json.loads(KINDS[kind].text()))


def refused_by_reader(kind: str, data: object, folder: Path) -> str | None:
    """None, "structure" for what a schema can state, or "meaning" for the rest."""
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
        return "meaning" if all(one["type"] in BEYOND_A_SCHEMA for one in cause.errors()) else "structure"
    return None


def changes(data: Any, node: Any) -> Iterator[tuple[str, Any]]:
    """Copies of `data` with one mistake each, for keys in `node`, a part of it."""
    items = list(node.items()) if isinstance(node, dict) else list(enumerate(node))[:1]  # one item for all of a list
    if isinstance(node, dict):
        node["no_such_key"] = 1.0
        yield "a key too many", copy.deepcopy(data)
        del node["no_such_key"]
    for key, value in items:
        for said, other in (("a word", "x"), ("a list", [["x"]]), ("a group", {"x": {}}), ("negative", -1e9)):
            node[key] = other
            yield f"{key}: {said}", copy.deepcopy(data)
        node[key] = value
        if isinstance(node, dict):
            del node[key]
            yield f"{key}: missing", copy.deepcopy(data)
            node[key] = value
        if isinstance(value, (dict, list)):
            yield from changes(data, value)


@pytest.mark.parametrize("kind", KINDS)
def test_the_shipped_schema_is_what_the_reader_says(kind: str) -> None:
    """If not: make schemas."""
    Draft202012Validator.check_schema(json.loads(KINDS[kind].text()))
    assert KINDS[kind].text() == json_schema(kind)


@pytest.mark.parametrize(("kind", "path"), FILES, ids=IDS)
def test_every_shipped_file_fits_its_schema_and_names_it(kind: str, path: Path) -> None:
    assert [error.message for error in validator(kind).iter_errors(read_yaml(path))] == []
    line = kept_editor_line(path)
    assert line
    named = path.parent / line.removeprefix(EDITOR_LINE).strip()
    assert os.path.normpath(named) == str(KINDS[kind].file)


def test_no_shipped_file_of_a_kind_is_left_out() -> None:
    """What names a schema in its first line is a file of a kind, and no file of a user's kind is without."""
    named = {
        path for room in ("models", "mpc", "sim", "bench", "app", "extras") for path in (ROOT / room).rglob("*.yaml")
    }
    named = {path for path in named if kept_editor_line(path)}
    assert named == {path.resolve() for _, path in FILES}
    folders = {path.resolve().parent for kind, path in FILES if kind not in ("proof", "tune", "conditions")}
    others = {path.name for folder in folders for path in folder.glob("*.yaml") if path not in named}
    # Settings of ours that lie beside the models of extras.
    assert others == {"robot.yaml", "settings.yaml", "training.yaml"}


EXAMPLES = [(kind, max(of.files, key=lambda path: path.stat().st_size)) for kind, of in KINDS.items() if of.files]
EXAMPLES += [("model", model_path(name)) for name in ("mbm", "lstm", "p2_physical")]


@pytest.mark.parametrize(("kind", "path"), EXAMPLES, ids=[f"{kind}-{path.stem}" for kind, path in EXAMPLES])
def test_schema_and_reader_agree_on_mistakes(kind: str, path: Path, tmp_path: Path) -> None:
    agree(kind, read_yaml(path), tmp_path)


def test_schema_and_reader_agree_on_mistakes_in_a_campaign(tmp_path: Path) -> None:
    agree("campaign", copy.deepcopy(CAMPAIGN), tmp_path)


def test_schema_and_reader_agree_on_mistakes_in_an_experiment(tmp_path: Path) -> None:
    columns = {"position RMSE [mm]": "mean position_rmse_m mm"}
    table = {"title": "Noise", "part": ["all"], "by": {"path": "trajectory"}, "columns": columns, "mean": True}
    parts = {"all": [{"horizon": [20, 30]}]}
    experiment = {
        "title": "Noise",
        "vary": {"trajectory": ["s"], "seed": [0, 1]},
        "parts": parts,
        "tables": {"n": table},
    }
    agree("experiment", experiment, tmp_path)


def agree(kind: str, data: Any, folder: Path) -> None:
    fits = validator(kind).is_valid
    assert fits(data)
    disagree = []
    every = list(changes(data, data))
    for said, changed in every[:: 1 + len(every) // 120]:
        refused = refused_by_reader(kind, changed, folder)
        if (refused == "structure") == fits(changed) and refused != "meaning":
            disagree.append((said, refused))
    assert disagree == []


def test_numbers_are_those_that_editors_read(tmp_path: Path) -> None:
    """YAML 1.2 and JSON: 1e-3 is a number."""
    path = tmp_path / "numbers.yaml"
    path.write_text("a: 1e-3\nb: -2.5E+2\nc: .5e1\nd: 1e\ne: e5\nf: '1e-3'\n", encoding="utf-8")
    assert read_yaml(path) == {"a": 1e-3, "b": -250.0, "c": 5.0, "d": "1e", "e": "e5", "f": "1e-3"}


def test_a_schema_is_printed_and_written(tmp_path: Path) -> None:
    runner = CliRunner()
    printed = runner.invoke(app, ["schema", "trajectory"]).stdout
    assert printed == KINDS["trajectory"].text()
    file = tmp_path / "new" / "trajectory.schema.json"
    invoke(app, "schema", "trajectory", "--out", file)
    assert file.read_text(encoding="utf-8") == printed
    assert Path(runner.invoke(app, ["schema", "model", "--path"]).stdout.strip()) == KINDS["model"].file
    listed = runner.invoke(app, ["schema"]).stdout
    assert all(name in listed for name in KINDS)
