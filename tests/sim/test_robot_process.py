"""`diffdrive-mpc sim-robot` as a process: how it starts, in real time, and how it ends."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from ros_driver import BOUND, own_domain, recorded, recorded_truth

from commands import invoke
from diffdrive_mpc.app.cli import app

COMMAND = str(Path(sys.executable).with_name("diffdrive-mpc"))


@pytest.fixture(autouse=True)
def ros(monkeypatch, tmp_path):
    own_domain(monkeypatch, tmp_path / "ros")


@contextmanager
def started(*words, says):
    """The process, once it has said these words; it does not outlive the context, nor the bound."""
    robot = subprocess.Popen([COMMAND, "sim-robot", "--plant", "model:ssm", *words], stderr=subprocess.PIPE, text=True)
    watchdog = threading.Timer(BOUND, robot.kill)
    watchdog.start()
    try:
        assert any(says in line for line in robot.stderr), "it ended before it was ready"
        yield robot
    finally:
        watchdog.cancel()
        robot.kill()
        robot.wait()
        robot.stderr.close()


@pytest.mark.parametrize(
    ("number", "mode", "says"),
    [(signal.SIGINT, "--real-time", "ready, in real time"), (signal.SIGTERM, "--lock-step", "waiting for")],
)
def test_a_signal_ends_it_cleanly(number, mode, says, tmp_path):
    """Also in lock step with nobody there, where it waits."""
    with started(mode, "--record", str(tmp_path / "bag"), says=says) as robot:
        robot.send_signal(number)
        _, errors = robot.communicate()
    assert robot.returncode == 0, errors
    assert "Traceback" not in errors
    assert (tmp_path / "bag" / "metadata.yaml").exists()


@pytest.mark.long
def test_in_real_time_stamps_stand_on_the_samples(tmp_path):
    """However late the machine is: this much time is not given up here."""
    shipped = (Path(__file__).parents[2] / "sim" / "ros" / "base.yaml").read_text()
    base = tmp_path / "base.yaml"
    base.write_text(shipped.replace("most_behind: 0.2", "most_behind: 60"))
    words = ["--duration", "0.5", "--base", str(base), "--trajectory", "square", "--record", str(tmp_path / "bag")]
    before = time.time_ns()
    result = subprocess.run(
        [COMMAND, "sim-robot", "--plant", "model:ssm", *words],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    stamps, _ = recorded(tmp_path / "bag", "/odom")
    assert np.array_equal(np.diff(stamps), np.full(24, 20_200_000))
    assert before < stamps[0] < stamps[-1] < time.time_ns()
    assert np.array_equal(recorded_truth(tmp_path / "bag"), np.zeros((25, 3)))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--command-timeout", "0"], "base settings: command_timeout: Input should be greater than 0"),
        (["--duration", "0"], "--duration 0.0: give a time in seconds, more than zero"),
        (["--sed", "3"], "unknown argument '--sed'"),
        (["--surface", "lava"], "unknown surface 'lava'"),
        (["--ros-args", "--foo"], "ROS cannot start with the arguments '--ros-args --foo'"),
        (["--record", "."], "is there already"),
    ],
)
def test_bad_input_ends_in_one_line(words, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(app, "sim-robot", *words, code=2)
    assert line in result.stderr and result.stderr.count("\n") == 1


def test_it_ticks_at_the_period_of_the_node_s_configuration(tmp_path):
    (tmp_path / "slow.yaml").write_text("model: ssm\nsample_time: 0.05\n")
    words = ["--plant", "model:ssm", "--config", str(tmp_path / "slow.yaml"), "--record", str(tmp_path / "bag")]
    invoke(app, "sim-robot", *words, "--duration", "0.4")
    assert np.array_equal(np.diff(recorded(tmp_path / "bag", "/odom")[0]), np.full(7, 50_000_000))


def test_remapped_topics_and_namespaces_hold_in_the_bag(tmp_path):
    words = ["--duration", "0.1", "--record", str(tmp_path / "bag"), "--ros-args", "-r", "odom:=wheels/odom"]
    result = subprocess.run(
        [COMMAND, "sim-robot", "--plant", "model:ssm", *words, "-r", "__ns:=/one"],
        capture_output=True,
        text=True,
        timeout=BOUND,
        check=False,
        env=os.environ,
    )
    assert result.returncode == 0, result.stderr
    assert len(recorded(tmp_path / "bag", "/one/wheels/odom")[0]) == 5
