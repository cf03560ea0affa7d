"""Replay: the same controller at the same measurements commands the same; what a log tells is said where it shows."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import load_config, load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.replay.open_loop import replay
from diffdrive_mpc.app.replay.own_log import read_own_csv
from diffdrive_mpc.app.replay.study import ReplayRequest, ReplayStudy
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import LatePlant, build
from diffdrive_mpc.bench.html_report.page import Chart
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_csv import write_log

DT = 0.0202
runner = CliRunner()

# Every kind of model, and everything that makes a controller leave its ordinary way.
CASES = {
    "circle": Case(),
    "sm": Case(model="sm", trajectory="square"),
    "mbm": Case(model="mbm", trajectory="cane"),
    "network": Case(model="lstm", trajectory="k_turn", overrides=(("horizon", 10),)),
    "drive": Case(model="p2_physical", trajectory="k_turn"),
    "tight, on its limits": Case(trajectory="tight", overrides=(("limits.v_slew", 0.6), ("limits.wheel_speed", 0.5))),
    "fast": Case(trajectory="fast_circle"),
    "pushed": Case(scenario="push"),
    "poses lost": Case(scenario="sensor_dropouts"),
    "poses jump": Case(scenario="pose_jump"),
    "poses drift": Case(scenario="drifting_pose"),
    "blocked": Case(scenario="blocked"),
    "late poses": Case(sensors="slam"),
    "rare poses": Case(sensors="poses_2hz"),
    "learning its dead time": Case(
        overrides=(("online_dead_time.enabled", True), ("online_dead_time.apply", True)), late=3
    ),
}


def logged(case, folder, change=None):
    """The run of a case, and its log."""
    controller, plant, reference = build(case)
    run = simulate(controller, plant if change is None else change(plant), reference)
    path = Path(folder) / "drive.csv"
    write_log(run, path)
    return run, path, controller.config


@pytest.mark.parametrize("name", CASES)
def test_a_log_of_a_run_replays_to_the_same_commands_from_the_file_alone(name, tmp_path):
    run, path, config = logged(CASES[name], tmp_path)
    recording = read_own_csv(path, config)
    again = replay(recording, config, recording.references, as_recorded=False)
    assert np.array_equal(recording.command, run.command)
    assert np.abs(again.command - run.command).max() < 1e-9
    assert again.modes == run.modes and again.solver_methods == run.solver_methods
    assert not recording.approximated
    # With the trajectory itself nothing is left but the same bits.
    exact = replay(recording, config, (load_trajectory(CASES[name].trajectory, config),), as_recorded=False)
    assert np.array_equal(exact.command, run.command)
    assert exact.messages == run.messages
    assert np.array_equal(exact.estimate, run.estimates, equal_nan=True)


def test_another_configuration_believes_what_was_sent_and_does_not_drift(tmp_path):
    """Heavier weights on the path ask for other commands, and the estimate stays what it was."""
    _, path, config = logged(Case(), tmp_path)
    recording = read_own_csv(path)
    same = replay(recording, config, recording.references, as_recorded=False)
    heavy = load_config("ssm", {"weights.across": 400.0, "limits.v_slew": 0.9})
    other = replay(recording, heavy, recording.references, as_recorded=False)
    assert np.abs(other.command - same.command).max() > 0.01
    assert np.abs(other.estimate - same.estimate).max() < 1e-12
    # Slew counts from the recorded command.
    before = recording.command[:-1]
    assert (np.abs(other.command[1:] - before)[:, 1] <= heavy.limits.omega_slew * DT + 1e-9).all()


def run_replay(*words):
    result = runner.invoke(app, ["replay", *map(str, words)])
    return result.exit_code, result.output + (str(result.exception) if result.exception else "")


def test_the_command_writes_every_tick_and_says_that_it_is_the_same(tmp_path):
    run, path, _ = logged(Case(trajectory="cane", plant="model:ssm"), tmp_path)
    out = tmp_path / "out"
    code, said = run_replay(path, "--model", "ssm", "--out", out, "--from", "2", "--to", "6")
    assert code == 0, said
    assert "the same at every tick" in said and "The reference is the one in the log" in said
    with (out / "replay.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == np.count_nonzero(run.time <= 6.0)
    assert float(rows[50]["replayed_v_m_s"]) == pytest.approx(run.command[50, 0], abs=1e-9)
    assert {row["mode"] for row in rows} == {"TRACKING"}
    found = json.loads((out / "replay.json").read_text())
    assert found["commands"][0]["differing"] == 0
    assert found["commands"][0]["compared"] == np.count_nonzero((run.time >= 2.0) & (run.time <= 6.0))
    assert (out / "figures" / "commands.png").is_file() and "Sensors" in (out / "replay.md").read_text()


def test_time_axes_begin_at_zero_whatever_the_clock_of_the_log_says(tmp_path):
    _, path, _ = logged(Case(plant="model:ssm"), tmp_path)
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    for row in rows:
        for i, name in enumerate(header):
            if name == "t_s" or name.endswith("_t_s"):
                row[i] = repr(float(row[i] or "nan") + 1.7e9)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    study = ReplayStudy(ReplayRequest(log=path, model="ssm"), tmp_path)
    with ProgressBar("replaying") as bar:
        report = study.report(study.run(study.plan(), 1, bar), 0.0)
    charts = [chart for chart in report.charts if isinstance(chart, Chart)]
    assert charts
    for chart in charts:
        assert chart.x.title == "time [s] since 1700000000.00 s on the log's clock"
        times = [time for series in chart.series for time in series.x]
        assert -0.1 < min(times) < 0.1 and max(times) < 60.0


def test_two_configurations_and_two_releases_are_compared(tmp_path):
    _, path, _ = logged(Case(trajectory="cane", plant="model:ssm"), tmp_path)
    first, second = tmp_path / "first", tmp_path / "second"
    code, said = run_replay(path, "--model", "ssm", "--set", "weights.across=300", "--against", "ssm", "--out", first)
    assert code == 0, said
    rows = {(row["one"], row["other"]): row for row in json.loads((first / "replay.json").read_text())["commands"]}
    assert rows["recorded", "ssm"]["differing"] == 0
    assert rows["recorded", "replayed"]["differing"] > 0
    # An earlier replay stands for another release.
    code, said = run_replay(path, "--model", "ssm", "--beside", first / "replay.csv", "--out", second)
    assert code == 0, said
    rows = {(row["one"], row["other"]): row for row in json.loads((second / "replay.json").read_text())["commands"]}
    beside = rows["replayed", str(first / "replay.csv")]
    assert beside["differing"] > 0 and beside["largest"][0] == pytest.approx(
        rows["recorded", str(first / "replay.csv")]["largest"][0], abs=1e-9
    )
    other = tmp_path / "other.csv"
    other.write_text("t_s,replayed_v_m_s,replayed_omega_rad_s\n0.5,0,0\n")
    code, said = run_replay(path, "--model", "ssm", "--beside", other, "--out", tmp_path / "third")
    assert code == 2 and "its ticks are not those of this log" in said


def verdicts(out):
    return " ".join(one["what"] for one in json.loads((out / "replay.json").read_text())["verdicts"])


@pytest.mark.long
def test_a_dead_time_that_is_too_short_is_found_to_a_few_milliseconds(tmp_path):
    """Commands reach the robot 100 ms later than the configuration knows."""
    _, path, _ = logged(Case(trajectory="slalom", seed=3), tmp_path, lambda plant: LatePlant(plant, 5))
    code, said = run_replay(path, "--model", "ssm", "--out", tmp_path / "out")
    assert code == 0, said
    found = json.loads((tmp_path / "out" / "replay.json").read_text())["dead_time"]
    assert np.subtract(found["value"], found["used"]) == pytest.approx([0.1, 0.1], abs=0.03)
    assert "The dead time of v is too short" in verdicts(tmp_path / "out")
    code, _ = run_replay(path, "--model", "ssm", "--out", tmp_path / "right", "--set", "extra_dead_time.v=0.11")
    assert code == 0 and "dead time of v" not in verdicts(tmp_path / "right")


def test_what_is_as_it_should_be_is_not_warned_of(tmp_path):
    _, path, _ = logged(Case(plant="model:ssm", trajectory="s"), tmp_path)
    code, _ = run_replay(path, "--model", "ssm", "--out", tmp_path / "out", "--set", "extra_dead_time.v=0")
    assert code == 0
    assert not {"pose", "late", "turns"} & set(verdicts(tmp_path / "out").split())


def test_lost_poses_and_limits_are_told_with_their_evidence(tmp_path):
    strict = {"limits.v_slew": 0.25, "failure.dead_reckoning": 0.0}
    _, path, _ = logged(Case(scenario="sensor_dropouts", overrides=tuple(strict.items())), tmp_path)
    changes = [word for key, value in strict.items() for word in ("--set", f"{key}={value}")]
    code, said = run_replay(path, "--model", "ssm", *changes, "--out", tmp_path / "out")
    assert code == 0, said
    words = verdicts(tmp_path / "out")
    assert "No pose came for" in words and "failure.max_pose_age" in words
    assert "BRAKING at" in words


def test_a_path_of_ones_own_is_known_at_the_ticks_and_said_to_be_so(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("segments:\n- {v: 0.4, omega: 0.3, duration: 3.0}\n- {v: 0.3, omega: -0.4, duration: 3.0}\n")
    run, log, config = logged(Case(trajectory=str(path), plant="model:ssm"), tmp_path)
    recording = read_own_csv(log)
    again = replay(recording, config, recording.references, as_recorded=False)
    assert np.abs(again.command - run.command).max() < 1e-9
    assert "--trajectory with its file makes that exact" in recording.approximated[0]


def test_an_mcap_log_replays_to_the_same_bits_with_its_own_configuration(tmp_path):
    """Also a model of one's own comes with the file."""
    model = tmp_path / "mine.yaml"
    model.write_text((Path(__file__).parents[2] / "models" / "parameters" / "sm.yaml").read_text())
    config = tmp_path / "config.yaml"
    config.write_text("model: mine.yaml\nhorizon: 20\nweights: {across: 90.0}\n")
    log = tmp_path / "drive.mcap"
    words = ["simulate", "--config", config, "--trajectory", "cane", "--plant", "model:sm", "--log", log]
    invoke(app, *words)
    for file in (model, config):
        file.unlink()
    code, said = run_replay(log, "--out", tmp_path / "out")
    assert code == 0, said
    found = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert found["commands"][0]["largest"] == [0.0, 0.0] and found["meta"]["config"]["horizon"] == 20
    code, said = run_replay(log, "--out", tmp_path / "other", "--set", "weights.across=500")
    assert code == 0 and "differ at" in said
