"""Bad input to every interface gives one line that names the place and the remedy: the rows of refusals.yaml."""

import copy
import pickle
import re
import shlex
from pathlib import Path

import control
import numpy as np
import pandas as pd
import pytest
import yaml

import diffdrive_mpc
from commands import invoke
from diffdrive_mpc import Controller
from diffdrive_mpc.app.cli import app as product
from diffdrive_mpc.bench.case import Case, parse_seeds
from diffdrive_mpc.bench.comparison.plan import default_settings, plan_cases
from diffdrive_mpc.bench.controllers import check_cases
from diffdrive_mpc.bench.sweep import sweep_settings
from diffdrive_mpc.models.checked_yaml import read_yaml
from diffdrive_mpc.models.load import load_base_effects, model_path
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.mpc.config.typed_settings import parse_single_settings
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits
from diffdrive_mpc.sim.disturbances.scenario import load_scenario
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from refusals import one_line_error
from studies.cli import app as studies

INTERFACES = yaml.safe_load(Path(__file__).with_name("refusals.yaml").read_text(encoding="utf-8"))
PROGRAMS = {"diffdrive-mpc ": product, "python -m studies ": studies}
SM, SSM = (yaml.safe_load(model_path(name).read_text(encoding="utf-8")) for name in ("sm", "ssm"))
TIMES = np.linspace(0.0, 10.0, 101)


def write_model(model):
    """Write a model file to the working directory and return its name."""
    Path("model.yaml").write_text(yaml.safe_dump(model), encoding="utf-8")
    return "model.yaml"


def written(text):
    """Write mine.yaml to the working directory and return its path."""
    Path("mine.yaml").write_text(text, encoding="utf-8")
    return Path("mine.yaml")


def scaled_matrix(name, factors):
    """Return a matrix of the SSM times a factor, or a factor for each row."""
    return (np.array(SSM[name]) * np.reshape(factors, (-1, 1))).tolist()


def started_controller():
    """Return a controller that has a reference."""
    controller = Controller("ssm")
    controller.start("s", 0.0)
    return controller


CALLS = (Case, TrajectoryLimits, WheelKinematics, check_cases, default_settings, load_base_effects, load_scenario)
CALLS += (load_sensor_set, load_surface, parse_seeds, plan_cases, read_yaml, write_model, written, scaled_matrix)
CALLS += (parse_single_settings, started_controller, sweep_settings)
NAMES = {name: getattr(diffdrive_mpc, name) for name in diffdrive_mpc.__all__}
NAMES |= {function.__name__: function for function in CALLS} | {"SM": SM, "SSM": SSM, "T": TIMES, "np": np, "pd": pd}
NAMES |= {"X": np.sin(0.5 * TIMES), "Y": 1.0 - np.cos(0.5 * TIMES), "SYSTEM": control.tf([1.0], [0.1, 1.0])}
NAMES |= {"diffdrive_mpc": diffdrive_mpc, "tf": control.tf, "copy": copy, "pickle": pickle}
"""Names in the expressions of refusals.yaml."""


def pattern_of(message):
    """Return a message of the table as a regular expression."""
    start = "^" if message.startswith("^") else ""
    return start + ".*".join(map(re.escape, message.removeprefix("^").split(" ... ")))


@pytest.mark.parametrize(
    ("interface", "row"),
    [pytest.param(door, row, id=f"{door['door']}: {row[0]}"[:60]) for door in INTERFACES for row in door["inputs"]],
)
def test_invalid_input_to_every_interface_gives_one_line(interface, row, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expression, (text, message, *more) = interface["door"], row
    files = dict(more and (more[0] if isinstance(more[0], dict) else {"mine.yaml": more[0]}))
    if "INPUT" not in expression:
        files[re.search(r"mine\.\w+", expression)[0]] = text
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content, encoding="latin-1")
    for program, app in PROGRAMS.items():
        if expression.startswith(program):
            files_before = sorted(tmp_path.rglob("*"))
            arguments = shlex.split(expression.removeprefix(program).replace("INPUT", text))
            result = invoke(app, *arguments, code=2)
            (line,) = result.stderr.splitlines()
            assert line.startswith("error: ") and result.stdout == ""
            assert re.search(pattern_of(message), line), line
            assert sorted(tmp_path.rglob("*")) == files_before
            return
    with one_line_error(eval(interface.get("error", "ConfigError"), NAMES), match=pattern_of(message)):
        eval(expression.replace("INPUT", text), NAMES)
