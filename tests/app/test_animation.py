"""Films of drives: what is in the pictures, and that the files are what their endings say."""

import csv
import itertools
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from commands import invoke
from diffdrive_mpc import ConfigError, Controller, load_config, load_trajectory, make_plant, simulate
from diffdrive_mpc.app.animation.animate import write_film
from diffdrive_mpc.app.animation.film import Film, film_path, read_size
from diffdrive_mpc.app.animation.pictures import pictures
from diffdrive_mpc.app.animation.playback import from_columns
from diffdrive_mpc.app.animation.recording import read_recording
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.sim.log_csv import write_log
from diffdrive_mpc.sim.log_mcap import write_log as write_mcap
from diffdrive_mpc.sim.view.body import robot_body

SMALL = Film(size=(480, 270), fps=10, speed=4.0)
SHORT = """\
name: short
segments:
  - {v: 0.5, omega: 0.5, duration: 1.5}
"""


@pytest.fixture(scope="module")
def run():
    controller = Controller(load_config("ssm"))
    return simulate(controller, make_plant("mujoco", scenario="push"), load_trajectory("circle"), keep_plans=True)


@pytest.fixture(scope="module")
def playback(run):
    return from_columns(run.columns, run.plans, (1.5, 2.0))


def probed(path):
    asked = "stream=codec_name,pix_fmt,width,height,nb_read_frames:format=duration"
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_entries", asked, "-of", "json", str(path)]
    told = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return told["streams"][0], float(told["format"]["duration"])


@pytest.mark.system("film")
def test_an_mp4_has_the_pictures_the_size_and_the_length_that_were_asked_for(playback, tmp_path):
    film = replace(SMALL, start=1.0, end=5.0)
    for name in ("one.mp4", "two.mp4"):
        write_film(playback, film, robot_body(), tmp_path / name)
    stream, duration = probed(tmp_path / "one.mp4")
    assert (stream["width"], stream["height"]) == (480, 270)
    assert (stream["codec_name"], stream["pix_fmt"]) == ("h264", "yuv420p")
    assert int(stream["nb_read_frames"]) == 11  # 4 s at four times the speed, and the first
    assert duration == pytest.approx(1.1, abs=0.05)
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()


@pytest.mark.parametrize("ending", ["webp", "gif"])
def test_pillow_writes_moving_pictures(playback, tmp_path, ending):
    path = tmp_path / f"film.{ending}"
    write_film(playback, replace(SMALL, start=2.0, end=4.0), robot_body(), path)
    with Image.open(path) as image:
        assert image.format == ending.upper()
        assert image.n_frames == 6
        frames, lasting = [], 0
        for k in range(image.n_frames):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")).astype(int))
            lasting += image.info["duration"]
    assert lasting == 600
    for one, other in itertools.pairwise(frames):
        assert (np.abs(one - other).max(axis=2) > 60).sum() > 50


def amber(picture):
    return np.argwhere((picture == (0xE6, 0x9F, 0x00)).all(axis=2)).mean(axis=0)


def test_the_robot_moves_along_its_way_and_looks_ahead(playback):
    """Its front is seen at one scale, x to the right and y up, and at one distance ahead of its poses: four numbers."""
    film = replace(SMALL, size=(960, 540), fps=2)
    seen = np.array([amber(frame) for frame in pictures(playback, film, robot_body())])
    pose = playback.at(film.times(playback))
    one, zero = np.ones(len(pose)), np.zeros(len(pose))
    columns = np.column_stack([pose[:, 0], np.cos(pose[:, 2]), one, zero])
    rows = -np.column_stack([pose[:, 1], np.sin(pose[:, 2]), zero, one])
    found, *_ = np.linalg.lstsq(np.concatenate([columns, rows]), np.concatenate([seen[:, 1], seen[:, 0]]))
    expected = np.concatenate([columns, rows]) @ found
    assert np.abs(expected - np.concatenate([seen[:, 1], seen[:, 0]])).max() < 1.5
    scale, ahead = found[0], found[1] / found[0]
    assert scale > 50
    assert 0.05 < ahead < robot_body().footprint[0] / 2


def test_only_what_moves_differs_from_picture_to_picture(playback):
    frames = [frame.copy() for frame in pictures(playback, replace(SMALL, fps=2), robot_body())]
    again = [frame.copy() for frame in pictures(playback, replace(SMALL, fps=2), robot_body())]
    assert all(np.array_equal(one, other) for one, other in zip(frames, again, strict=True))
    changed = np.any([(frames[0] != frame).any(axis=2) for frame in frames[1:]], axis=0)
    assert 0.02 < changed.mean() < 0.4
    assert not changed[-8:].any()  # labels of the axes


def test_a_log_gives_the_pictures_of_its_run_but_for_the_plan(run, playback, tmp_path):
    write_log(run, tmp_path / "run.csv")
    logged = read_recording(tmp_path / "run.csv", limits=(1.5, 2.0))
    without = replace(playback, plans=np.empty((0, 0, 3)))
    film = replace(SMALL, start=6.0, end=6.0)
    (one,), (other,) = (list(pictures(drive, film, robot_body())) for drive in (logged, without))
    assert np.array_equal(one, other)
    (planned,) = list(pictures(playback, film, robot_body()))
    assert not np.array_equal(one, planned)


def test_a_log_with_plans_gives_the_pictures_of_its_run(run, playback, tmp_path):
    write_mcap(run, tmp_path / "run.mcap", {"configuration": {"yaml": "limits: {v: 1.5, omega: 2.0}"}})
    film = replace(SMALL, start=6.0, end=6.0)
    logged = read_recording(tmp_path / "run.mcap")
    (one,), (other,) = (list(pictures(drive, film, robot_body())) for drive in (logged, playback))
    assert np.array_equal(one, other)


def test_where_nobody_knows_the_true_pose_the_estimate_is_shown(run, playback):
    columns = {
        name: np.full(len(run.time), np.nan) if name.startswith("true") else rows for name, rows in run.columns.items()
    }
    guessed = from_columns(columns, run.plans)
    assert guessed.told == "estimated"
    assert np.nanmedian(np.abs(guessed.position_error - playback.position_error)) < 0.005
    assert list(pictures(guessed, replace(SMALL, start=6.0, end=6.0), None))


def test_errors_of_a_log_are_those_of_its_run(run, playback):
    assert np.array_equal(playback.position_error, run.errors.position)
    assert playback.lateral_error == pytest.approx(run.errors.lateral, abs=2e-5)
    assert np.abs(run.errors.lateral).max() > 0.05


def test_a_robots_own_log_shows_what_it_has(run, tmp_path):
    """No truth, no reference, other names: the poses as measured, and an arrow."""
    write_log(run, tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = {"t_s": "t", "v_ref_m_s": "v", "omega_ref_rad_s": "w", "v_wheel_m_s": "ve", "omega_wheel_rad_s": "we"}
    names |= {"pose_x_m": "x", "pose_y_m": "y", "pose_theta_rad": "yaw"}
    with (tmp_path / "own.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names.values())
        writer.writerows([row[name] for name in names] for row in rows)
    mapping = "source: a test\ncolumns:\n  time: t\n  command: {v: v, omega: w}\n  encoders: {v: ve, omega: we}\n"
    (tmp_path / "own.yaml").write_text(mapping + "  pose: {x: x, y: y, theta: yaw}\n")
    own = read_recording(tmp_path / "own.csv", str(tmp_path / "own.yaml"))
    assert own.told == "measured"
    assert own.reference.size == own.position_error.size == own.plans.size == 0
    assert np.abs(own.at(run.time[100:600])[:, :2] - run.true_pose[100:600, :2]).max() < 0.06
    words = ["animate", str(tmp_path / "own.csv"), "--mapping", str(tmp_path / "own.yaml"), "--size", "480x270"]
    result = invoke(app, *words, "--out", tmp_path / "own.png")
    assert "no reference" in result.output
    assert "an arrow" in result.output
    with Image.open(tmp_path / "own.png") as image:
        assert image.size == (480, 270)


@pytest.mark.system("rendering")
def test_a_render_stands_beside_the_view_from_above(playback):
    film = replace(SMALL, render=True, start=4.0, end=4.0)
    (with_render,) = list(pictures(playback, film, robot_body()))
    (alone,) = list(pictures(playback, replace(film, alone=True), robot_body()))
    blue = np.array([0, 114, 178])
    for picture in (with_render[:, :240], with_render[:, 240:], alone):
        assert (np.abs(picture.astype(int) - blue).max(axis=2) < 40).sum() > 30
    assert alone.shape == with_render.shape == (270, 480, 3)


def test_endings_choose_and_what_is_missing_is_named(monkeypatch, tmp_path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "ffmpeg").touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert film_path(tmp_path / "film").suffix == ".mp4"
    with pytest.raises(ConfigError, match=r"cannot write '.avi'; give a file that ends in .mp4, .webp, .gif, .png"):
        film_path(tmp_path / "film.avi")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert film_path(tmp_path / "film").suffix == ".webp"
    with pytest.raises(ConfigError, match=r"MP4 needs ffmpeg.*install it, or name a .webp or .gif file"):
        film_path(tmp_path / "film.mp4")


def test_ffmpeg_that_fails_says_why_and_leaves_nothing(playback, tmp_path, monkeypatch):
    broken = tmp_path / "bin" / "ffmpeg"
    broken.parent.mkdir()
    broken.write_text("#!/bin/sh\necho no encoder for this >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", f"{broken.parent}{os.pathsep}/usr/bin{os.pathsep}/bin")
    with pytest.raises(ConfigError, match="ffmpeg failed: no encoder for this"):
        write_film(playback, replace(SMALL, start=0.0, end=4.0), robot_body(), tmp_path / "film.mp4")


@pytest.mark.parametrize("text", ["1280", "12x", "99999x720", "100x100", "axb"])
def test_sizes_that_are_none_are_refused(text):
    with pytest.raises(ConfigError, match="--size"):
        read_size(text)


def test_odd_sizes_become_even():
    assert read_size("641x361") == (640, 360)


def test_from_and_to_outside_the_drive_are_named(run, tmp_path):
    write_log(run, tmp_path / "run.csv")
    words = ["animate", str(tmp_path / "run.csv"), "--out", str(tmp_path / "film.webp"), "--from", "99"]
    result = invoke(app, *words, code=2)
    assert "the drive goes from 0.0 to" in result.output
    assert not (tmp_path / "film.webp").exists()


def test_a_part_without_poses_is_named(playback):
    """A log with a gap in it."""
    unknown = np.where((playback.time > 4.0)[:, None] & (playback.time < 6.0)[:, None], np.nan, playback.pose)
    gap = replace(playback, pose=unknown)
    with pytest.raises(ConfigError, match="from 4.5 to 5.5 s the log knows no pose"):
        next(pictures(gap, replace(SMALL, start=4.5, end=5.5), robot_body()))
    frames = list(pictures(gap, replace(SMALL, start=3.0, end=5.5), robot_body()))
    front = [(frame == (0xE6, 0x9F, 0x00)).all(axis=2).sum() for frame in frames]
    assert min(front[:2]) > 0
    assert max(front[3:]) == 0


@pytest.mark.system("window")
def test_a_drive_that_is_watched_is_the_same_bit_for_bit(tmp_path):
    (tmp_path / "short.yaml").write_text(SHORT)
    simulate_it = [str(Path(sys.executable).with_name("diffdrive-mpc")), "simulate", "--trajectory", "short.yaml"]
    screen = [shutil.which("xvfb-run") or "xvfb-run", "-a", "-s", "-screen 0 640x480x24"]
    for before, words in (([], ["--log", "plain.csv"]), (screen, ["--view", "--log", "watched.csv"])):
        done = subprocess.run(
            [*before, *simulate_it, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    plain, watched = (list(csv.DictReader((tmp_path / f"{name}.csv").open())) for name in ("plain", "watched"))
    times = {"step_time_s", "solve_time_s"}
    assert [{k: v for k, v in row.items() if k not in times} for row in plain] == [
        {k: v for k, v in row.items() if k not in times} for row in watched
    ]
