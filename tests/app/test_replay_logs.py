"""Logs of others, and logs that are broken: what a replay makes of them, and what it says."""

import csv
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from diffdrive_mpc.app.cli import app
from diffdrive_mpc.app.replay.assembly import Readings, assembled, on_grid
from diffdrive_mpc.app.replay.own_log import read_own_csv
from diffdrive_mpc.app.replay.reading import from_mid_drive, read_recording
from diffdrive_mpc.app.replay.signals import driven_paths
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.log_csv import write_log

DT = 0.0202
runner = CliRunner()
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
