"""`diffdrive-mpc twin`: from a log to a plant file, and mistakes in one line."""

import json

import pytest
import yaml
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot

runner = CliRunner()


def run(*words):
    return runner.invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "drive.csv"
    result = run("simulate", "--model", "sm", "--trajectory", "s", "--log", path)
    assert result.exit_code == 0, result.stderr
    return path


@pytest.mark.long
@pytest.mark.usefixtures("quick_search")
def test_a_log_becomes_a_plant(log):
    out = log.parent / "twin"
    result = run("twin", log, "--seconds", 5, "--jobs", 1, "--out", out)
    assert result.exit_code == 0, result.stderr
    numbers = json.loads((out / "twin.json").read_text())
    twin, model = (numbers[name]["fit_percent"] for name in ("twin", "model"))
    # The log is of this physics: a velocity model cannot beat it by much, whatever the noise.
    assert all(twin[channel] > model[channel] - 2.0 for channel in ("v", "omega"))
    found = {one["name"]: one for one in numbers["parameters"]}
    robot = load_simulated_robot(out / "plant.yaml")
    assert robot.friction == pytest.approx(found["friction"]["value"], rel=1e-6)
    assert robot.twin.link.dead_time == pytest.approx(found["dead_time"]["value"], rel=1e-6)
    assert found["dead_time"]["low"] <= 0.040 <= found["dead_time"]["high"]
    assert found["gain_v"]["low"] <= 1.0 <= found["gain_v"]["high"]
    stated = yaml.safe_load((out / "plant.yaml").read_text())["firmware"]["provenance"]["parameters"]
    assert {name: one["told"] for name, one in stated.items()} == {name: one["told"] for name, one in found.items()}
    report = (out / "twin.md").read_text()
    assert all(f"| {name} |" in report for name in found)
    assert (out / "figures" / "held_out.png").stat().st_size > 0
    make_plant(f"mujoco:{out / 'plant.yaml'}").advance((0.2, 0.0))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--seconds", "1"], "error: --seconds 1: give 5 or more of the log to fit"),
        (["--robot", "nobody"], "error: unknown robot 'nobody'"),
        (["--model", "lstm"], "error: model 'lstm' is a function"),
        (["--model", "sm", "--effects"], "error: --effects: the model of --model has those of its file"),
    ],
)
def test_a_mistake_is_one_line(log, words, line):
    result = run("twin", log, *words, "--out", log.parent / "none")
    assert result.exit_code == 2
    assert line in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (log.parent / "none").exists()
