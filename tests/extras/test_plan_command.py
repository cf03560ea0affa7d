"""`diffdrive-mpc plan`: what it writes can be driven, and mistakes are one line."""

import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.models.turn_costs import load_turn_costs, turn_costs_text
from diffdrive_mpc.mpc import load_trajectory


def run(*arguments):
    return CliRunner().invoke(app, ["plan", *arguments])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("plan")
    costs = out / "mine.yaml"
    costs.write_text(turn_costs_text(load_turn_costs("fsu_bot-grippy")), encoding="utf-8")
    result = run(
        "--costs", str(costs), "--from", "1,-1,90", "--to", "-4,6,180", "--via", "0,3", "--out", str(out / "a")
    )
    assert result.exit_code == 0, result.output
    return out / "a", result


def test_the_trajectory_goes_from_pose_to_pose(written):
    folder, _ = written
    path = load_trajectory(folder / "trajectory.csv")
    begin, end = path.sample([0.0, path.duration]).pose
    assert begin == pytest.approx([1.0, -1.0, math.pi / 2], abs=1e-6)
    assert end[:2] == pytest.approx([-4.0, 6.0], abs=1e-6)
    assert math.cos(end[2]) == pytest.approx(-1.0)
    way = path.sample(np.linspace(0, path.duration, 2000)).pose
    assert np.hypot(*(way[:, :2] - [0.0, 3.0]).T).min() < 0.02


def test_the_table_and_the_file_say_the_same_and_energy_is_least(written):
    folder, result = written
    plans = {one["minimise"]: one for one in json.loads((folder / "plan.json").read_text())["plans"]}
    assert plans["energy"]["energy_j"] == min(one["energy_j"] for one in plans.values())
    assert plans["time"]["duration_s"] == min(one["duration_s"] for one in plans.values())
    assert f"{plans['distance']['energy_j']:.1f}" in result.output
    assert {"paths.png", "power.png"} == {path.name for path in (folder / "figures").iterdir()}
    assert "energy, written" in (folder / "plan.md").read_text() and (folder / "report.html").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--from", "0,0", "--to", "5,0,0"), "give X,Y,DEG, 3 numbers"),
        (("--from", "0,0,0", "--to", "5,nan,0"), "give X,Y,DEG, 3 numbers"),
        (("--from", "0,0,0", "--to", "5,0,0", "--via", "1"), "give X,Y, 2 numbers"),
        (("--from", "0,0,0", "--to", "5,0,0", "--minimise", "fuel"), "give energy, time or distance"),
        (("--from", "0,0,0", "--to", "5,0,0", "--costs", "fsu_bot-defualt"), "did you mean 'fsu_bot-default'"),
        (("--from", "0,0,0", "--to", "0,1,0"), "least radius of"),
    ],
)
def test_a_mistake_is_one_sentence_and_writes_nothing(tmp_path, arguments, words):
    result = run(*arguments, "--out", str(tmp_path / "out"))
    assert result.exit_code != 0 and words in " ".join(result.output.replace("│", " ").split())
    assert not (tmp_path / "out").exists()


def test_a_long_way_is_pointed_out_and_a_computer_on_board_shortens_it(tmp_path):
    ends = ("--costs", "fsu_bot-grippy", "--from", "0,0,0", "--to=-3,7,90")
    lengths = []
    for drawn in ((), ("--idle-power", "10")):
        result = run(*ends, *drawn, "--out", str(tmp_path / "plan"))
        assert result.exit_code == 0, result.output
        energy = json.loads((tmp_path / "plan" / "plan.json").read_text())["plans"][0]
        lengths.append(energy["length_m"])
        assert ("times as long as the shortest" in result.output) == (not drawn)
    assert lengths[1] < 0.8 * lengths[0]
