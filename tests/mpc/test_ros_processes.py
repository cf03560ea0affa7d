"""The node as a process of its own: interrupted or killed while it drives."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ros_parts import FakeBase

from commands import invoke
from diffdrive_mpc.app.cli import app

COMMAND = Path(sys.executable).with_name("diffdrive-mpc")


@pytest.fixture
def driving():
    """A base, and the process that drives it in simulated time."""
    process = subprocess.Popen(
        [COMMAND, "node", "--drive", "--ros-args", "-p", "use_sim_time:=true", "-p", "start_at_robot:=false"],
        stderr=subprocess.PIPE,
        text=True,
    )
    base = FakeBase(lambda: time.sleep(0.001))
    try:
        base.until(lambda: moving(base, process), "the first command that moves the robot")
        base.run(20)
        yield base, process
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
        base.close()


def moving(base, process):
    """Let a tick pass; whether the robot is driven."""
    assert process.poll() is None, process.stderr.read()
    base.silent(1)
    return base.commands and any(base.commands[-1])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupted_it_sends_zero_last(driving, number):
    base, process = driving
    assert any(base.commands[-1])
    process.send_signal(number)
    base.until(lambda: process.poll() is not None, "the end of the process")
    for _ in range(20):
        base.spin()
    assert base.commands[-1] == (0.0, 0.0)
    assert process.returncode == 0


def test_killed_it_is_silent(driving):
    """It cannot send zero then: the base has to stop by itself when commands cease."""
    base, process = driving
    process.kill()
    process.wait()
    assert base.silent(5) == 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--trajectory", "circel", "--autostart"], "unknown trajectory 'circel'"),
        (["--set", "weights.acros=1"], "did you mean 'weights.across'?"),
        (["--trajectry", "s"], "unknown argument '--trajectry'"),
    ],
)
def test_what_cannot_be_started_ends_in_one_line(words, line):
    result = invoke(app, "node", *words, code=2)
    assert line in result.stderr and result.stderr.count("\n") == 1


def test_a_parameter_that_cannot_be_ends_the_process_in_one_line():
    words = ["--ros-args", "-p", "weights.across:=-1.0"]
    result = subprocess.run([COMMAND, "node", *words], capture_output=True, text=True, timeout=60, check=False)
    (error,) = (text for text in result.stderr.splitlines() if text.startswith("error: "))
    assert result.returncode == 2
    assert "weights.across" in error
