"""The drive that tells slip terms apart: it stays in its square, and tells more than any path of one speed."""

import math

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from commands import invoke
from diffdrive_mpc import load_trajectory
from diffdrive_mpc.app.cli import app
from diffdrive_mpc.mpc.trajectories.excitation import slip_excitation, told_apart, write_excitation
from diffdrive_mpc.mpc.trajectories.load import load_segments


@pytest.mark.parametrize(
    ("side", "speed", "yaw_rate"), [(3.0, 0.6, 1.0), (6.0, 0.6, 1.0), (6.0, 1.0, 0.5), (20.0, 2.0, 1.0)]
)
def test_it_stays_in_its_square_and_tells_the_terms_apart(tmp_path, side, speed, yaw_rate):
    write_excitation(tmp_path / "drive.yaml", slip_excitation(side, 60.0, speed, yaw_rate))
    if speed <= 1.5:
        drive = load_trajectory(tmp_path / "drive.yaml")
        pose = drive.sample(np.linspace(0.0, drive.duration, 2000)).pose
        # Smoothing may cut a corner by its own tolerance.
        assert np.abs(pose[:, :2]).max() <= 0.5 * side - 0.2
    segments = load_segments(tmp_path / "drive.yaml")
    assert told_apart(segments) < 0.5
    assert max(abs(one.v) for one in segments) <= speed + 1e-9
    assert max(abs(one.omega) for one in segments) <= yaw_rate + 1e-9


def test_a_circle_tells_nothing_apart():
    assert told_apart(load_segments("circle")) == pytest.approx(1.0)
    # At one speed, to both sides: omega and v omega are one.
    assert told_apart(load_segments("s")) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.5, 60.0, 0.6, 1.0), "give 2.1 m or more"),
        ((6.0, 60.0, math.nan, 1.0), "speed nan: give a positive number"),
        ((6.0, -1.0, 0.6, 1.0), "time -1.0: give a positive number"),
    ],
)
def test_what_cannot_be_driven_is_refused(arguments, said):
    with pytest.raises(ValueError, match=said):
        slip_excitation(*arguments)


def test_the_command_writes_a_trajectory_and_says_what_it_tells(tmp_path):
    path = tmp_path / "slip.yaml"
    result = invoke(app, "excite", "--for", "slip", "--side", "5", "--out", path)
    assert "the two least apart correlate by 0." in result.output
    assert yaml.safe_load(path.read_text())["timing"] == "smooth"
    refused = CliRunner().invoke(app, ["excite", "--for", "mass", "--out", str(tmp_path / "no.yaml")])
    assert refused.exit_code != 0
    assert not (tmp_path / "no.yaml").exists()
