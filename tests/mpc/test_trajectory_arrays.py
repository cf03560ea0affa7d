"""Trajectories from arrays and waypoints in memory: what they trace, and what is said where columns are wrong."""

import numpy as np
import pandas as pd
import pytest

from diffdrive_mpc import ConfigError, Controller, Trajectory, load_config
from diffdrive_mpc.mpc.trajectories.speed_check import starts_beyond_slew

TIMES = np.linspace(0.0, 10.0, 101)
RATE = 0.5
ANGLE = RATE * TIMES
X, Y = np.sin(ANGLE), 1.0 - np.cos(ANGLE)
HALF = np.full(TIMES.size, RATE)
WELL = {"t": TIMES, "x": X, "y": Y}


@pytest.mark.parametrize(
    ("more", "error"),
    [
        ({}, 1e-3),
        ({"theta": ANGLE}, 1e-6),
        ({"theta": (ANGLE + np.pi) % (2 * np.pi) - np.pi}, 1e-6),
        ({"v": HALF}, 1e-3),
        ({"theta": ANGLE, "v": HALF, "omega": HALF}, 1e-7),
    ],
    ids=["positions", "headings", "wrapped headings", "speeds", "all"],
)
def test_a_circle_of_arrays_is_that_circle(more, error):
    reference = Trajectory.from_arrays(TIMES + 100.0, X, Y, **more)
    times = np.linspace(0.0, 9.99, 777)
    sample = reference.sample(times)
    angle = RATE * times
    np.testing.assert_allclose(sample.pose, np.column_stack([np.sin(angle), 1 - np.cos(angle), angle]), atol=error)
    np.testing.assert_allclose(sample.twist, RATE, atol=error)
    assert reference.duration == 10.0
    assert repr(reference) == "Trajectory 'arrays': 10 s, 5 m"


def test_lists_and_columns_of_pandas_are_arrays():
    table = pd.DataFrame(WELL)
    expected = Trajectory.from_arrays(**WELL).sample(TIMES).pose
    for columns in ({name: table[name] for name in "txy"}, {name: values.tolist() for name, values in WELL.items()}):
        np.testing.assert_array_equal(Trajectory.from_arrays(**columns).sample(TIMES).pose, expected)


def test_a_negative_speed_drives_backwards_and_a_robot_that_stands_keeps_its_heading():
    backwards = Trajectory.from_arrays(TIMES, -0.3 * TIMES, 0 * TIMES, v=np.full(TIMES.size, -0.3)).sample([5.0])
    np.testing.assert_allclose(backwards.pose, [[-1.5, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(backwards.twist, [[-0.3, 0.0]], atol=1e-12)
    waiting = np.clip(TIMES - 3.0, 0.0, 4.0) * 0.5
    headings = Trajectory.from_arrays(TIMES, np.zeros(TIMES.size), waiting).sample([0.0, 5.0, 10.0]).pose[:, 2]
    np.testing.assert_allclose(headings, np.pi / 2, atol=1e-9)


DATES = pd.date_range("2026-01-01", periods=TIMES.size, freq="100ms")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": X[:-1]}, "x has 100 values, t has 101; give one for each time"),
        ({"x": np.column_stack([X, Y])}, r"x: expected one number per time, shape \(n,\), got shape \(101, 2\)"),
        ({"x": np.where(TIMES > 5.0, np.nan, X)}, r"x\[51\] is not a finite number"),
        ({"t": TIMES[::-1]}, r"t\[1\] = 9.9 s does not come after the time before; sort the rows"),
        ({"t": ["a"] * TIMES.size}, "t: expected numbers, got list"),
        ({"t": DATES}, r"t: got dates; give seconds, such as \(t - t\[0\]\) / np.timedelta64\(1, 's'\)"),
        ({"t": TIMES * 1e9}, "it lasts 1e.10 s, the longest is 86400 s; are times in s?"),
        ({"x": 0 * X, "y": 0 * Y}, "x and y do not change, so they have no direction; give theta"),
        ({"theta": np.degrees(ANGLE)}, r"theta fits the path in degrees, not in rad; give np.radians\(theta\)"),
        ({"theta": 0 * ANGLE}, "sideways speed = .* let theta point along the direction of travel"),
        ({"v": 3.6 * HALF}, "v = 1.8 m/s at t = .* the poses change by 0.5 m/s; check unit and sign"),
        ({"theta": ANGLE, "v": -HALF}, "v = -0.5 m/s .* the poses change by 0.5 m/s; check unit and sign"),
        ({"omega": np.degrees(HALF)}, "omega = 28.6 rad/s .* change by 0.5 rad/s; check unit and sign"),
    ],
)
def test_wrong_columns_are_one_sentence(columns, message):
    with pytest.raises(ConfigError, match=f"^trajectory 'mine': {message}") as caught:
        Trajectory.from_arrays(**{**WELL, **columns}, name="mine")
    assert "\n" not in str(caught.value)


def test_waypoints_are_passed_from_rest_to_rest_within_the_limits_of_a_configuration():
    points = np.array([[0.0, 0.0], [3.0, 0.0], [6.0, 1.0]])
    config = load_config("ssm", {"limits.v": 0.4, "limits.predicted_v": 0.4})
    reference = Trajectory.from_waypoints(points, limits=config)
    sample = reference.sample(np.linspace(0.0, reference.duration, 2000))
    assert np.abs(sample.twist[:, 0]).max() == pytest.approx(0.4)
    assert sample.twist[[0, -1]] == pytest.approx(0.0, abs=1e-9)
    for x, y in points:
        assert np.hypot(sample.pose[:, 0] - x, sample.pose[:, 1] - y).min() < 2e-3
    fast = Trajectory.from_waypoints([(0, 0), (30, 0)], speed=3.0)
    assert fast.sample([fast.duration / 2]).twist[0, 0] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("points", "settings", "message"),
    [
        (np.zeros((2, 5)), {}, r"points: expected rows x, y of shape \(m, 2\), got shape \(2, 5\)"),
        ([(0, 0), (1,)], {}, "points: expected numbers, got list"),
        ("path.csv", {}, "points: expected numbers, got str 'path.csv'"),
        ([(0, 0)], {}, "1 waypoints; give at least two"),
        ([(0, 0), (1, 0)], {"speed": -1.0}, "speed = -1.0 m/s; give a positive number"),
        ([(0, 0), (1, 0)], {"timing": "fast"}, "timing 'fast'; give stop, commanded or smooth"),
    ],
)
def test_wrong_waypoints_are_one_sentence(points, settings, message):
    with pytest.raises(ConfigError, match=f"^trajectory 'waypoints': {message}"):
        Trajectory.from_waypoints(points, **settings)


def test_a_reference_that_is_faster_than_the_controllers_limits_is_refused_at_the_start():
    with pytest.raises(ValueError, match="reference 'arrays': v = 4 at .* is more than limits.v"):
        Controller("ssm").start(Trajectory.from_arrays(TIMES, 4.0 * TIMES, 0 * TIMES), 0.0)


def test_a_start_faster_than_the_slew_is_told_and_one_from_rest_is_not():
    limits, dt = load_config("ssm").limits, 0.0202
    told = starts_beyond_slew(Trajectory.from_arrays(TIMES, 0.85 * TIMES, 0 * TIMES), limits, dt)
    assert told.startswith("reference 'arrays' starts at 0.85 m/s and 0 rad/s, the robot at rest: limits.v_slew = ")
    assert starts_beyond_slew(Trajectory.from_waypoints([(0, 0), (1, 0)]), limits, dt) == ""
