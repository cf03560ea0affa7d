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
from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.open_loop import replay
from diffdrive_mpc.app.replay.own_log import read_own_csv
from diffdrive_mpc.app.replay.reading import from_mid_drive, read_recording
from diffdrive_mpc.app.replay.signals import driven_paths
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


FOREIGN = """columns:
  time: t
  command: {v: v, omega: w}
  encoders: {v: ev, omega: ew}
  gyro: {yaw_rate: g}
"""
WITH_POSES = FOREIGN + "  pose: {x: x, y: y, theta: th, delay: 0.1}\n"


@pytest.fixture(scope="module")
def run():
    controller, plant, reference = build(Case(plant="model:ssm", trajectory="circle"))
    return simulate(controller, plant, reference)


@pytest.fixture
def log(run, tmp_path):
    write_log(run, tmp_path / "drive.csv")
    return tmp_path / "drive.csv"


def foreign(run, folder, change=lambda rows: rows, mapping=WITH_POSES):
    """The run as somebody else would log it."""
    sensors = [run.wheel_twist, run.gyro[:, None], run.measured_pose]
    rows = change(np.column_stack([run.time + 50.0, run.command, *sensors]))
    path = Path(folder) / "foreign.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "v", "w", "ev", "ew", "g", "x", "y", "th"])
        writer.writerows([["" if np.isnan(cell) else repr(cell) for cell in row] for row in rows.tolist()])
    (Path(folder) / "mapping.yaml").write_text(mapping)
    return path, Path(folder) / "mapping.yaml"


def replayed(*words):
    result = runner.invoke(app, ["replay", *map(str, words)])
    return result.exit_code, result.output + str(result.exception or "")


def test_a_tick_gets_the_newest_that_had_arrived_and_nothing_twice():
    time = np.array([0.0, 1.0, 2.0, 3.0])
    poses = Readings(np.array([-2.0, -0.5, 1.0, 1.5, 2.5]), np.arange(5.0), np.arange(15.0).reshape(5, 3))
    ticks = assembled(time, np.ones((4, 2)), {"pose": poses})
    got = [None if tick.measurement.pose is None else tick.measurement.pose.time for tick in ticks]
    assert got == [1.0, 2.0, 3.0, 4.0]
    assert assembled(time, np.ones((4, 2)), {"pose": Readings(time - 0.5, time, np.zeros((4, 3)))})[0].start is not None


def test_a_drive_begins_with_the_first_command_that_moves():
    command = np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.0]])
    ticks = assembled(np.arange(4.0), command, {})
    assert [tick.time for tick in ticks] == [2.0, 3.0]
    assert np.array_equal(ticks[0].start.before, np.zeros((2, 2)))


def test_commands_of_another_rate_are_laid_on_a_grid_and_that_is_said():
    time, command = np.arange(0.0, 1.0, 0.1), np.arange(20.0).reshape(10, 2)
    same, _, nothing = on_grid(time, command, 0.11, "log")
    assert same is time and not nothing
    grid, held, (words,) = on_grid(time, command, 0.05, "log")
    assert len(grid) == 19 and np.array_equal(held[::2], command) and np.array_equal(held[1::2], command[:-1])
    assert "every 100 ms" in words and "50 ms" in words


def test_the_driven_path_is_where_the_robot_was_when_it_was_there(run, tmp_path):
    path, mapping = foreign(run, tmp_path)
    recording = read_recording(path, str(mapping), DT, tmp_path)
    (reference,) = driven_paths(recording)
    start = recording.ticks[0].start.t0
    # Poses are stamped a tenth of a second earlier than they were logged.
    inside = (run.time > 2.0) & (run.time < 8.0)
    there = reference.sample(run.time[inside] + 50.0 - 0.1 - start).pose
    apart = there - run.measured_pose[inside]
    assert np.abs(apart[:, :2]).max() < 0.04 and np.abs(np.sin(apart[:, 2])).max() < 0.04
    code, said = replayed(path, "--mapping", mapping, "--model", "ssm", "--out", tmp_path / "out")
    assert code == 0, said
    assert "the driven path itself" in " ".join(said.split()) and "how differently this" in " ".join(said.split())
    assert "Another one drove" in said


def test_without_poses_it_says_what_would_happen_and_offers_dead_reckoning(run, tmp_path):
    path, mapping = foreign(run, tmp_path, mapping=FOREIGN)
    words = (path, "--mapping", mapping, "--model", "ssm", "--out", tmp_path / "out")
    code, said = replayed(*words)
    assert code == 2 and "no poses" in said and "--pose odometry" in said
    code, said = replayed(*words, "--trajectory", "circle")
    assert code == 0 and "No pose is in the log: the controller would not drive" in " ".join(said.split())
    code, said = replayed(*words, "--pose", "odometry")
    assert code == 0 and "stand-in: dead reckoning" in " ".join(said.split())
    recording = read_recording(path, str(mapping), DT, tmp_path, "odometry")
    last = recording.ticks[-1].measurement.pose.value
    assert np.hypot(*last[:2]) < 2.0 and last[2] == pytest.approx(run.true_pose[-1, 2], rel=0.5)


def test_a_log_that_begins_in_mid_drive_says_so(run, log, tmp_path):
    lines = log.read_text().splitlines()
    (tmp_path / "late.csv").write_text("\n".join([lines[0], *lines[200:]]) + "\n")
    recording = from_mid_drive(read_own_csv(tmp_path / "late.csv"), (2.0, 6.0), DT)
    assert "begins in mid-drive, at 0.5" in recording.approximated[-1]
    assert np.allclose(recording.ticks[0].start.before[0], run.command[199])
    whole = read_own_csv(log)
    # Another configuration with less slew does not make it so.
    assert from_mid_drive(whole, (0.01, 0.01), DT) is whole
    assert from_mid_drive(whole, (2.0, 6.0), DT) is whole


def test_gaps_and_leaps_of_the_clock_are_told(run, tmp_path):
    def change(rows):
        rows[300:, 0] += 1.2
        return rows

    path, mapping = foreign(run, tmp_path, change, WITH_POSES + "gap: 5.0\n")
    code, said = replayed(path, "--mapping", mapping, "--model", "ssm", "--out", tmp_path / "out")
    said = " ".join(said.split())
    assert code == 0, said
    assert "commands came late: the longest pause is 1.2" in said and "No pose came for 1.2" in said


def cut_off(text):
    return text[: len(text) - 40]


def not_a_number(text):
    return text.replace(text.splitlines()[5].split(",")[1], "fast", 1)


def without_a_command(text):
    lines = text.splitlines()
    cells = lines[30].split(",")
    lines[30] = ",".join([cells[0], "", *cells[2:]])
    return "\n".join(lines) + "\n"


BROKEN = {
    "cut off": (cut_off, 0, "the last line is cut off; it is left out"),
    "no number": (not_a_number, 2, "leave a cell empty where a reading is missing"),
    "a command unknown": (without_a_command, 0, "replayed"),
    "too short": (lambda text: "\n".join(text.splitlines()[:6]) + "\n", 2, "at least 10 are needed; record for longer"),
    "empty": (lambda text: text.splitlines()[0] + "\n", 2, "holds no row"),
    "a row too short": (lambda text: text.replace("\n", "\n1,2\n", 3), 2, "cells, the header names"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_logs_cost_one_line(name, log, tmp_path):
    change, expected, words = BROKEN[name]
    log.write_text(change(log.read_text()))
    code, said = replayed(log, "--model", "ssm", "--out", tmp_path / "out")
    assert code == expected, said
    assert words in " ".join(said.split())


def test_a_log_that_is_not_there_is_one_line_and_without_out_it_goes_into_a_folder(log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said = replayed("nowhere.csv", "--model", "ssm")
    assert code == 2 and "nowhere.csv: there is no such file or folder" in said
    code, said = replayed(log, "--model", "ssm")
    assert code == 0 and (tmp_path / "replayed" / "replay.csv").is_file()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), "does not hold the configuration of its controller; give --config or --model"),
        (("--model", "ssm", "--to", "0.1"), "--to 0.1: the drive begins at 0.00 s"),
        (("--model", "ssm", "--from", "99"), "--from 99: the log ends at"),
        (("--model", "ssm", "--sample-time", "0.1"), "its ticks come every 20.2 ms, sample_time is 100 ms"),
        (("--model", "ssm", "--pose", "gps"), "give log or odometry"),
        (("--model", "ssm", "--trajectory", "nowhere"), "nowhere"),
        (("--model", "ssm", "--against", "nothing"), "nothing"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_in_one_line(words, expected, log, tmp_path):
    code, said = replayed(log, "--out", tmp_path / "out", *words)
    assert code == 2 and expected in " ".join(said.split())
    assert "Traceback" not in said and not (tmp_path / "out").exists()
