"""A reference of the user that gives other shapes than it is asked for: nothing is read out of bounds."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import Controller, Measurement, Stamped, load_config, load_trajectory
from diffdrive_mpc.mpc import Mode

CONFIG = load_config("ssm")


class OwnReference:
    """The circle by a class of the user, which C cannot sample; `change` acts from its sample number `late` on."""

    def __init__(self, change, late=0):
        self.circle, self.change, self.left = load_trajectory("circle"), change, late
        self.name, self.duration = "own", self.circle.duration

    def sample(self, times):
        self.left -= 1
        sample = self.circle.sample(times)
        return sample if self.left >= 0 else self.change(sample)


def short(sample):
    return sample._replace(pose=sample.pose[:-1], twist=sample.twist[:-1])


CHANGES = {
    "one sample short": short,
    "no heading": lambda sample: sample._replace(pose=sample.pose[:, :2]),
    "transposed": lambda sample: sample._replace(pose=sample.pose.T),
    "poses as twists": lambda sample: sample._replace(twist=sample.pose),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_start_says_which_shape_is_expected(change):
    with pytest.raises(ValueError, match=r"reference 'own': (pose|twist) of sample\(times\) has shape .*; expected \("):
        Controller(CONFIG).start(OwnReference(change), 0.0)


def drive(change, late=30, ticks=60):
    """Steps of a robot that stands on its first pose; the reference is wrong from its sample number `late` on."""
    controller = Controller(CONFIG)
    reference = OwnReference(change, late)
    pose = reference.circle.sample([0.0]).pose[0]
    controller.start(reference, 0.0)
    times = CONFIG.sample_time * np.arange(ticks)
    return [controller.step(t, Measurement(pose=Stamped(pose, t), yaw_rate=Stamped(0.0, t))) for t in times.tolist()]


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_step_never_raises_and_stops_the_robot(change):
    steps = drive(change)
    assert steps[1].mode is Mode.TRACKING
    assert "there is nothing to track: reference 'own': " in steps[-1].message
    assert steps[-1].mode in (Mode.BRAKING, Mode.STOPPED)
    assert np.isfinite([step.command for step in steps]).all()


@pytest.mark.parametrize("whole_numbers", [False, True])
def test_numbers_of_another_kind_are_read_as_numbers(whole_numbers):
    """Lists and integers have the right shape, and another layout in memory."""

    def listed(sample):
        kind = np.int64 if whole_numbers else np.float32
        return sample._replace(pose=np.zeros(sample.pose.shape, kind), twist=np.zeros(sample.twist.shape, kind))

    last = drive(listed)[-1]
    assert last.mode is Mode.TRACKING and last.plan is not None


def test_the_address_sanitizer_finds_nothing(tmp_path):
    """The core reads by its own count: compiled with the sanitizer, a row too few would end the process."""
    library = subprocess.run(["gcc", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True).stdout
    code = (
        "from diffdrive_mpc.models.compiled import compiler\n"
        "compiler._FLAGS = ('-std=c99', '-O0', '-fPIC', '-fsanitize=address')\n"
        "from test_reference_shapes import CHANGES, drive\n"
        "for change in CHANGES.values(): drive(change)\n"
        "print('driven')\n"
    )
    environment = os.environ | {
        "LD_PRELOAD": library.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "DIFFDRIVE_MPC_CACHE": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
    }
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment, timeout=300
    )
    assert result.stdout == "driven\n", result.stderr[-2000:]
