"""Trajectory files: contents, limits and arrays."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicHermiteSpline
from trajectory_checks import assert_holds_its_ends

from diffdrive_mpc import ConfigError, Trajectory, load_config, load_trajectory
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.mpc.trajectories.smooth_segments import time_smooth_path
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.timed_poses import fit_timed_poses
from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_poses(path: Path, times: FloatArray, poses: FloatArray) -> Path:
    rows = np.column_stack([times, poses])
    np.savetxt(path, rows, delimiter=",", header="t,x,y,theta", comments="", fmt="%.12g")
    return path


def test_segments_of_a_file_start_at_their_pose(tmp_path: Path) -> None:
    path = write(
        tmp_path, "line.yaml", "start: [1, 2, 1.5707963267948966]\nsegments: [{v: 0.5, omega: 0, duration: 2}]\n"
    )
    trajectory = load_trajectory(str(path))
    assert trajectory.name == "line"
    pose = trajectory.sample([0.0, trajectory.duration]).pose
    np.testing.assert_allclose(pose, [(1, 2, np.pi / 2), (1, 3, np.pi / 2)], atol=1e-15)


def test_limits_argument_replaces_the_limits_of_the_robot() -> None:
    slow = TrajectoryLimits(v=0.5, omega=0.5, v_acceleration=0.1, omega_acceleration=2.0)
    assert load_trajectory("circle", slow).duration == pytest.approx(4 * np.pi + 5.0)
    with pytest.raises(ConfigError, match=r"segments\.1\.omega"):
        load_trajectory("square", slow)


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_timed_poses_reproduce_their_trajectory(tmp_path: Path, name: str) -> None:
    original = load_trajectory(name)
    times = np.append(np.arange(0, original.duration, 0.02), original.duration)
    poses = original.sample(times).pose
    poses[:, 2] = wrap_angle(poses[:, 2])
    copy = load_trajectory(write_poses(tmp_path / "copy.csv", times + 7.0, poses))
    assert copy.name == "copy"
    assert copy.duration == pytest.approx(original.duration)
    instants = np.linspace(0, original.duration, 3001)
    expected, actual = original.sample(instants), copy.sample(instants)
    # A corner of the speed, where the acceleration jumps by up to 2 rad/s^2, is rounded over about one row of 20 ms.
    np.testing.assert_allclose(actual.pose, expected.pose, rtol=0, atol=2 * 0.02**2 / 8)
    np.testing.assert_allclose(actual.twist, expected.twist, rtol=0, atol=2 * 0.02 / 4)
    # At each of at most eight starts and stops of 1 m/s^2, rounding moves the robot slightly back and forth.
    np.testing.assert_allclose(actual.arc_length, expected.arc_length, rtol=0, atol=8 * 1 * 0.02**2 / 8)
    assert_holds_its_ends(copy)


def test_two_rows_give_a_straight_line_at_constant_speed(tmp_path: Path) -> None:
    path = write(tmp_path, "line.csv", "theta,note,t,y,x\n0,go,5,1,2\n\n0,stop,7,1,3\n")
    trajectory = load_trajectory(path)
    sample = trajectory.sample([0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(sample.pose, [(2, 1, 0), (2.5, 1, 0), (3, 1, 0), (3, 1, 0)], atol=1e-14)
    np.testing.assert_allclose(sample.twist, [(0.5, 0), (0.5, 0), (0.5, 0), (0, 0)], atol=1e-14)
    np.testing.assert_allclose(sample.arc_length, [0, 0.5, 1, 1], atol=1e-14)


def test_arc_length_never_decreases_within_a_piece_with_two_sign_changes() -> None:
    # v = (t - 0.113) (t - 0.5) over one piece of 1 s.
    first, second = 0.113, 0.5
    end = 1 / 3 - (first + second) / 2 + first * second
    poses = np.array([(0.0, 0.0, 0.0), (end, 0.0, 0.0)])
    rates = np.array([(first * second, 0.0, 0.0), ((1 - first) * (1 - second), 0.0, 0.0)])
    trajectory = SplineTrajectory.through("test", np.array([0.0, 1.0]), poses, rates)
    arc_length = trajectory.sample(np.linspace(0, 1, 1000)).arc_length
    assert np.all(np.diff(arc_length) >= -1e-15)
    assert trajectory.sample([0.3]).twist[0, 0] == pytest.approx((0.3 - first) * (0.3 - second))


def test_cubic_pieces_equal_the_pieces_of_scipy() -> None:
    random = np.random.default_rng(3)
    times, (poses, rates) = np.append(0.0, np.cumsum(random.uniform(0.02, 0.7, 40))), random.normal(size=(2, 41, 3))
    trajectory = SplineTrajectory.through("test", times, poses, rates)
    expected = CubicHermiteSpline(times, poses, rates)
    assert np.array_equal(trajectory.table.reshape(4, 4, -1)[:, :3], expected.c.transpose(0, 2, 1))
    sample_times = random.uniform(0.0, times[-1], 200)
    sampled = trajectory.sample(sample_times)
    assert sampled.pose == pytest.approx(expected(sample_times), abs=1e-12)
    derivative = expected(sample_times, 1)
    forward = derivative[:, 0] * np.cos(sampled.pose[:, 2]) + derivative[:, 1] * np.sin(sampled.pose[:, 2])
    assert sampled.twist == pytest.approx(np.column_stack([forward, derivative[:, 2]]), abs=1e-11)


_LIMITS = TrajectoryLimits.of_robot()


def _wave(count: int) -> list[tuple[float, float]]:
    return [(0.2 * i, 0.3 * math.sin(0.05 * i)) for i in range(count)]


def test_legs_with_few_pieces_satisfy_the_limits() -> None:
    """Speed, yaw rate and accelerations from differences of the twist, between and at the nodes."""
    path = time_waypoints(_wave(12_000), _LIMITS, name="wave")
    times = np.arange(10.0, 40.0, 0.001)
    twist = path.sample(times).twist
    rate = np.diff(twist, axis=0) / 0.001
    assert np.abs(twist).max(axis=0) == pytest.approx([_LIMITS.v, 0.0], abs=_LIMITS.omega)
    assert np.abs(twist[:, 0]).max() <= _LIMITS.v * 1.001
    assert np.abs(twist[:, 1]).max() <= _LIMITS.omega * 1.001
    assert np.abs(rate[:, 0]).max() <= _LIMITS.v_acceleration * 1.01
    assert np.abs(rate[:, 1]).max() <= _LIMITS.omega_acceleration * 1.01


# The last path has a long segment between short segments: a check of the joints alone would not find its length.
LONG_PATHS = [[(0.4, 0.1, 1e9)], [(0.0, 0.1, 1e9)], [(0.5, -0.5, 0.003), (-0.5, 0.001, 1e6), (0.5, 0.8, 3.0)]]


@pytest.mark.parametrize("rows", LONG_PATHS)
def test_path_with_too_many_pieces_is_rejected_before_its_computation(rows: list[tuple[float, float, float]]) -> None:
    """The first path would need 149 GiB."""
    segments = [Segment(v=v, omega=omega, duration=duration) for v, omega, duration in rows]
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"^here: its length requires .* pieces"):
        time_smooth_path(segments, _LIMITS, name="x", where="here")
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_too_many_points_segments_or_joints_raise_error_with_their_number() -> None:
    """Each count is checked before the computation of the path."""
    settings = load_settings()
    with pytest.raises(ConfigError, match=r"here: 50,001 points, at most 50,000"):
        time_waypoints(_wave(50_001), _LIMITS, name="x", where="here")
    rows = np.zeros((settings.max_pieces // settings.min_pieces_per_row + 1, 4))
    rows[:, 0] = np.arange(len(rows))
    with pytest.raises(ConfigError, match=r"here: 500,001 points"):
        fit_timed_poses(rows, _LIMITS, name="x", where="here")
    segment = Segment(v=0.1, omega=0.0, duration=1.0)
    with pytest.raises(ConfigError, match=r"here: 100,001 segments"):
        time_segments([segment] * (settings.max_segments + 1), _LIMITS, name="x", where="here")
    curved = [Segment(v=0.2, omega=1e-5 * i, duration=1.0) for i in range(settings.max_joints + 2)]
    with pytest.raises(ConfigError, match=r"here: 5,001 different joints"):
        time_smooth_path(curved, _LIMITS, name="x", where="here")


def test_reading_of_poses_stops_at_the_maximum_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory is that of the permitted rows, not of all rows in the file."""
    settings = load_settings().model_copy(update={"max_pieces": 2000})
    monkeypatch.setattr("diffdrive_mpc.mpc.trajectories.timed_poses.load_settings", lambda: settings)
    file = tmp_path / "long.csv"
    file.write_text("t,x,y,theta\n" + "".join(f"{i},0,0,0\n" for i in range(200_000)), encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(ConfigError, match="more than 1,000 timed poses"):
        load_trajectory(file)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_path_of_two_millimetres_is_driven_from_rest_to_rest() -> None:
    """The path has one piece: without an inner node its speed would be zero everywhere."""
    path = time_smooth_path([Segment(v=1.0, omega=0.0, duration=0.002)], _LIMITS, name="x")
    end = path.sample([path.duration]).pose[0]
    assert end == pytest.approx([0.002, 0.0, 0.0], abs=1e-9)
    assert 0.0 < path.duration < 1.0


TIMES = np.linspace(0.0, 10.0, 101)
RATE = 0.5
ANGLE = RATE * TIMES
X, Y = np.sin(ANGLE), 1.0 - np.cos(ANGLE)
SPEEDS = np.full(TIMES.size, RATE)
COLUMNS = {"t": TIMES, "x": X, "y": Y}


@pytest.mark.parametrize(
    ("columns", "error"),
    [
        ({}, 1e-3),
        ({"theta": ANGLE}, 1e-6),
        ({"theta": (ANGLE + np.pi) % (2 * np.pi) - np.pi}, 1e-6),
        ({"v": SPEEDS}, 1e-3),
        ({"theta": ANGLE, "v": SPEEDS, "omega": SPEEDS}, 1e-7),
    ],
    ids=["positions", "headings", "wrapped headings", "speeds", "all"],
)
def test_arrays_of_a_circle_give_the_circle(columns, error):
    reference = Trajectory.from_arrays(TIMES + 100.0, X, Y, **columns)
    times = np.linspace(0.0, 9.99, 777)
    sample = reference.sample(times)
    angle = RATE * times
    np.testing.assert_allclose(sample.pose, np.column_stack([np.sin(angle), 1 - np.cos(angle), angle]), atol=error)
    np.testing.assert_allclose(sample.twist, RATE, atol=error)
    assert reference.duration == 10.0


def test_lists_and_pandas_columns_are_accepted_as_arrays():
    table = pd.DataFrame(COLUMNS)
    expected = Trajectory.from_arrays(**COLUMNS).sample(TIMES).pose
    for columns in ({name: table[name] for name in "txy"}, {name: values.tolist() for name, values in COLUMNS.items()}):
        np.testing.assert_array_equal(Trajectory.from_arrays(**columns).sample(TIMES).pose, expected)


def test_negative_speed_drives_backwards_and_standstill_keeps_heading():
    backwards = Trajectory.from_arrays(TIMES, -0.3 * TIMES, 0 * TIMES, v=np.full(TIMES.size, -0.3)).sample([5.0])
    np.testing.assert_allclose(backwards.pose, [[-1.5, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(backwards.twist, [[-0.3, 0.0]], atol=1e-12)
    waiting = np.clip(TIMES - 3.0, 0.0, 4.0) * 0.5
    headings = Trajectory.from_arrays(TIMES, np.zeros(TIMES.size), waiting).sample([0.0, 5.0, 10.0]).pose[:, 2]
    np.testing.assert_allclose(headings, np.pi / 2, atol=1e-9)


def test_waypoints_are_passed_within_the_limits_of_a_configuration():
    points = np.array([[0.0, 0.0], [3.0, 0.0], [6.0, 1.0]])
    config = load_config("ssm", {"limits.v": 0.4, "limits.predicted_v": 0.4})
    reference = Trajectory.from_waypoints(points, limits=config)
    sample = reference.sample(np.linspace(0.0, reference.duration, 2000))
    assert np.abs(sample.twist[:, 0]).max() == pytest.approx(0.4)
    assert sample.twist[[0, -1]] == pytest.approx(0.0, abs=1e-9)
    for x, y in points:
        assert np.hypot(sample.pose[:, 0] - x, sample.pose[:, 1] - y).min() < 0.05
    fast = Trajectory.from_waypoints([(0, 0), (30, 0)], speed=3.0)
    assert fast.sample([fast.duration / 2]).twist[0, 0] == pytest.approx(3.0)


@pytest.mark.parametrize("name", ["circle", "slalom"])
def test_start_delay_inserts_a_rest_before_the_trajectory(name):
    original, delayed = (load_trajectory(name, load_config("ssm", {"start_delay": delay})) for delay in (0.0, 0.3))
    assert delayed.duration == original.duration + 0.3
    times = np.linspace(-0.5, delayed.duration + 0.5, 500)
    for expected, actual in zip(original.sample(times - 0.3), delayed.sample(times), strict=True):
        assert np.allclose(expected, actual, rtol=0, atol=1e-12)
    assert np.allclose(original.drawn_distance(times - 0.3), delayed.drawn_distance(times), atol=1e-12)
