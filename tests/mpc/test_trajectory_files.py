"""Trajectories from files: what is read, and the one line that each mistake gets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from trajectory_checks import assert_holds_its_ends, largest_integration_gap

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.trajectories import BUILT_IN, TrajectoryLimits, load_trajectory
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_poses(path: Path, times: FloatArray, poses: FloatArray) -> Path:
    rows = np.column_stack([times, poses])
    np.savetxt(path, rows, delimiter=",", header="t,x,y,theta", comments="", fmt="%.12g")
    return path


def error_line(name_or_path: str | Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_trajectory(name_or_path)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_segments_from_a_file_start_at_their_pose(tmp_path: Path) -> None:
    path = write(
        tmp_path, "line.yaml", "start: [1, 2, 1.5707963267948966]\nsegments: [{v: 0.5, omega: 0, duration: 2}]\n"
    )
    trajectory = load_trajectory(str(path))
    assert trajectory.name == "line"
    pose = trajectory.sample([0.0, trajectory.duration]).pose
    np.testing.assert_allclose(pose, [(1, 2, np.pi / 2), (1, 3, np.pi / 2)], atol=1e-15)


def test_a_file_may_name_its_trajectory(tmp_path: Path) -> None:
    path = write(tmp_path, "a.yml", "name: long way\nsegments: [{v: 0.5, omega: 0, duration: 2}]\n")
    assert load_trajectory(path).name == "long way"


def test_given_limits_replace_those_of_the_robot() -> None:
    slow = TrajectoryLimits(v=0.5, omega=0.5, v_acceleration=0.1, omega_acceleration=2.0)
    assert load_trajectory("circle", slow).duration == pytest.approx(4 * np.pi + 5.0)
    with pytest.raises(ConfigError, match=r"segments\.1\.omega"):
        load_trajectory("square", slow)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("segments: []\n", "segments is empty; give at least one"),
        ("segments:\n", "segments"),
        ("", "found nothing"),
        ("segments: [{v: 0.5, omega: 0, duration: 1}, {v: 9, omega: 0, duration: 1}]\n", "segments.1.v = 9 m/s"),
        ("segments: [{v: .nan, omega: 0, duration: 1}]\n", "segments.0.v: Input should be a finite number"),
        ("segments: [{v: 0.5, omega: .inf, duration: 1}]\n", "segments.0.omega: Input should be a finite number"),
        ("segments: [{v: 0.5, omega: 0, duration: -1}]\n", "segments.0.duration: Input should be greater than 0"),
        ("segments: [{v: 0.5, omega: 0, duration: 0}]\n", "segments.0.duration: Input should be greater than 0"),
        ("segments: [{v: 0.5, omga: 0, omega: 0, duration: 1}]\n", "unknown key 'segments.0.omga'; did you mean"),
        (
            "segments: [{v: 0.5, omega: 0, duration: 1}]\nstrat: [0, 0, 0]\n",
            "unknown key 'strat'; did you mean 'start'",
        ),
        ("segments: [{v: 0.5, omega: 0}]\n", "key 'segments.0.duration' is missing"),
        ("segments: [{v: fast, omega: 0, duration: 1}]\n", "segments.0.v: Input should be a valid number"),
        ("segments: [{v: 0.5, omega: 0, duration: 1}\n", "line 2"),
        ("waypoints: []\n", "0 waypoints; give at least two"),
        ("waypoints: [[0, 0]]\n", "1 waypoints; give at least two"),
        ("waypoints: [[0, 0], [1, 0], [1, 0]]\n", "waypoints.1 and waypoints.2 coincide; remove one"),
        ("waypoints: [[0, 0], [1, .nan]]\n", "waypoints.1.1: Input should be a finite number"),
        ("waypoints: [[0, 0], [1, 0]]\nspeed: 2\n", "speed = 2 m/s is beyond the limit of 1.5 m/s; lower it"),
        ("waypoints: [[0, 0], [1, 0]]\nspeed: -1\n", "speed: Input should be greater than 0"),
        ("waypoints: [[0, 0], [1, 0]]\nsped: 1\n", "unknown key 'sped'; did you mean 'speed'"),
        ("waypoints: [[0, 0], [1, 0], [0, 0]]\n", "add or move waypoints to round the turn"),
        ("waypoints: [[0, 0], [1, 0], [0.3, 0]]\n", "below 0.02 m between waypoints.0 and waypoints.1; add or move"),
        ("waypoints: [[0, 0], [1, 0], [0, 0.02]]\n", "add or move waypoints to round the turn"),
    ],
)
def test_a_mistake_in_a_yaml_file_is_told_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    path = write(tmp_path, "bad.yaml", text)
    message = error_line(path)
    assert message.startswith(str(path))
    assert expected in message


def test_an_unknown_name_gets_the_nearest_and_all_known() -> None:
    message = error_line("cirle")
    assert message.startswith(
        f"unknown trajectory 'cirle': give one of {', '.join(BUILT_IN)}, spline-SEED or the path of"
    )
    assert message.endswith("; did you mean 'circle'?")


@pytest.mark.parametrize("name", ["missing.yaml", "missing.csv"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    message = error_line(tmp_path / name)
    assert message.startswith(f"unknown trajectory '{tmp_path / name}': give one of")


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_timed_poses_of_a_trajectory_give_it_back(tmp_path: Path, name: str) -> None:
    original = load_trajectory(name)
    times = np.append(np.arange(0, original.duration, 0.02), original.duration)
    poses = original.sample(times).pose
    poses[:, 2] = wrap_angle(poses[:, 2])
    copy = load_trajectory(write_poses(tmp_path / "copy.csv", times + 7.0, poses))
    assert copy.name == "copy"
    assert copy.duration == pytest.approx(original.duration)
    between = np.linspace(0, original.duration, 3001)
    expected, found = original.sample(between), copy.sample(between)
    # A corner of the speed, where the acceleration jumps by up to 2 rad/s^2, is rounded over about a row of 20 ms.
    np.testing.assert_allclose(found.pose, expected.pose, rtol=0, atol=2 * 0.02**2 / 8)
    np.testing.assert_allclose(found.twist, expected.twist, rtol=0, atol=2 * 0.02 / 4)
    # At each of at most eight starts and stops of 1 m/s^2 that rounding moves the robot to and fro a little.
    np.testing.assert_allclose(found.arc_length, expected.arc_length, rtol=0, atol=8 * 1 * 0.02**2 / 8)
    assert_holds_its_ends(copy)


def test_timed_poses_of_a_smooth_drive_agree_with_their_twist(tmp_path: Path) -> None:
    circle = load_trajectory("circle")
    times = np.linspace(1.0, 12.0, 111)
    copy = load_trajectory(write_poses(tmp_path / "arc.csv", times, circle.sample(times).pose))
    assert isinstance(copy, SplineTrajectory)
    assert largest_integration_gap(copy, copy.breaks, pieces=1) < 1e-4
    assert np.all(np.diff(copy.sample(np.linspace(0, 11, 5000)).arc_length) > 0)


def test_two_rows_are_a_straight_line_at_constant_speed(tmp_path: Path) -> None:
    path = write(tmp_path, "line.csv", "theta,note,t,y,x\n0,go,5,1,2\n\n0,stop,7,1,3\n")
    trajectory = load_trajectory(path)
    sample = trajectory.sample([0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(sample.pose, [(2, 1, 0), (2.5, 1, 0), (3, 1, 0), (3, 1, 0)], atol=1e-14)
    np.testing.assert_allclose(sample.twist, [(0.5, 0), (0.5, 0), (0.5, 0), (0, 0)], atol=1e-14)
    np.testing.assert_allclose(sample.arc_length, [0, 0.5, 1, 1], atol=1e-14)


def test_timed_poses_may_drive_backwards(tmp_path: Path) -> None:
    path = write(tmp_path, "back.csv", "t,x,y,theta\n0,0,0,0\n1,-0.5,0,0\n2,-1,0,0\n")
    sample = load_trajectory(path).sample([1.0, 2.0])
    np.testing.assert_allclose(sample.twist[:, 0], -0.5)
    np.testing.assert_allclose(sample.arc_length, [0.5, 1.0])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "line 1: column 't' is missing; the header"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"t,x,y\n0,0,0\n1,0,0\n", "line 1: column 'theta' is missing; the header"),
        (b"0,0,0,0\n1,0,0,0\n", "line 1: column 't' is missing; the header"),
        (b"t,x,y,theta\n", "0 timed poses; give at least two rows"),
        (b"t,x,y,theta\n0,0,0,0\n", "1 timed poses; give at least two rows"),
        (b"t,x,y,theta\n0,0,0,0\n1,0.5,zero,0\n", "line 3: y = 'zero' is not a finite number"),
        (b"t,x,y,theta\n0,0,0,0\n1,nan,0,0\n", "line 3: x = 'nan' is not a finite number"),
        (b"t,x,y,theta\n0,0,0,0\n1,0.5\n", "line 3: 2 values are fewer than the header names"),
        (b"t,x,y,theta\n0,0,0,0\n\n2,1,0,0\n1,0.5,0,0\n", "line 5: t = 1 s does not come after the row before"),
        (b"t,x,y,theta\n0,0,0,0\n0,0.5,0,0\n", "line 3: t = 0 s does not come after the row before"),
        (
            b"t,x,y,theta\n5,0,0,0\n6,3,0,0\n",
            "v = 3 m/s at t = 5.000 s is beyond the limit of 1.5 m/s; stretch the time",
        ),
        (b"t,x,y,theta\n0,0,0,0\n1,0,0,3\n", "omega = 3 rad/s at t = 0.000 s is beyond the limit of 2 rad/s"),
        (
            b"t,x,y,theta\n0,0,0,0\n1,0,0.5,0\n",
            "sideways speed = 0.5 m/s at t = 0.000 s is beyond the limit of 0.05 m/s",
        ),
    ],
)
def test_a_mistake_in_a_csv_file_is_told_in_one_line(tmp_path: Path, text: bytes, expected: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(text)
    message = error_line(path)
    assert message.startswith(str(path))
    assert expected in message


def test_arc_length_never_falls_where_the_speed_changes_sign_twice_inside_a_piece() -> None:
    # v = (t - 0.113) (t - 0.5) over one piece of 1 s.
    first, second = 0.113, 0.5
    end = 1 / 3 - (first + second) / 2 + first * second
    poses = np.array([(0.0, 0.0, 0.0), (end, 0.0, 0.0)])
    rates = np.array([(first * second, 0.0, 0.0), ((1 - first) * (1 - second), 0.0, 0.0)])
    trajectory = SplineTrajectory.through("test", np.array([0.0, 1.0]), poses, rates)
    arc_length = trajectory.sample(np.linspace(0, 1, 1000)).arc_length
    assert np.all(np.diff(arc_length) >= -1e-15)
    assert trajectory.sample([0.3]).twist[0, 0] == pytest.approx((0.3 - first) * (0.3 - second))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segments:\n- {v: 0.1, omega: 0.1, duration: 1.0e+12}\n", "are times in s"),
        ("waypoints: [[0, 0], [1.0e+200, 0]]\n", "less than or equal to 1000000"),
    ],
    ids=["a trajectory of years", "waypoints beyond the horizon"],
)
def test_a_mistake_of_units_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_trajectory(write(tmp_path, "units.yaml", text))


def test_cubic_pieces_are_those_of_scipy() -> None:
    random = np.random.default_rng(3)
    times, (poses, rates) = np.append(0.0, np.cumsum(random.uniform(0.02, 0.7, 40))), random.normal(size=(2, 41, 3))
    trajectory = SplineTrajectory.through("test", times, poses, rates)
    expected = CubicHermiteSpline(times, poses, rates)
    assert np.array_equal(trajectory.table.reshape(4, 4, -1)[:, :3], expected.c.transpose(0, 2, 1))
    at = random.uniform(0.0, times[-1], 200)
    sampled = trajectory.sample(at)
    assert sampled.pose == pytest.approx(expected(at), abs=1e-12)
    change = expected(at, 1)
    forward = change[:, 0] * np.cos(sampled.pose[:, 2]) + change[:, 1] * np.sin(sampled.pose[:, 2])
    assert sampled.twist == pytest.approx(np.column_stack([forward, change[:, 2]]), abs=1e-11)
