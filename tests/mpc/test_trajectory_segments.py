"""Trajectories from segments and from waypoints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectory_checks import assert_holds_its_ends, largest_integration_gap, largest_shares

from diffdrive_mpc import load_trajectory
from diffdrive_mpc.models import pose as pose_kinematics
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.arcs import ArcTrajectory
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.waypoints import time_waypoints

LIMITS = TrajectoryLimits(v=1.5, omega=2.0, v_acceleration=1.0, omega_acceleration=2.0)

_v = st.one_of(st.just(0.0), st.just(0.5), st.just(-0.5), st.floats(-1.5, 1.5))
_omega = st.one_of(st.just(0.0), st.just(0.5), st.just(-1.0), st.floats(-2.0, 2.0))
_segments = st.lists(st.builds(Segment, v=_v, omega=_omega, duration=st.floats(0.02, 3.0)), min_size=1, max_size=6)
_start = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-4, 4))


def lay(*twists: tuple[float, float, float]) -> ArcTrajectory:
    segments = [Segment(v=v, omega=omega, duration=duration) for v, omega, duration in twists]
    return time_segments(segments, LIMITS, name="test")


@given(_segments)
def test_random_sequences_satisfy_every_limit(segments: list[Segment]) -> None:
    shares = largest_shares(time_segments(segments, LIMITS, name="test"), LIMITS)
    assert np.all(shares <= 1 + 1e-8), shares


@given(_segments)
def test_speeds_do_not_exceed_the_maximum_of_the_segments(segments: list[Segment]) -> None:
    trajectory = time_segments(segments, LIMITS, name="test")
    twist = np.abs(trajectory.sample(np.linspace(0, trajectory.duration, 500)).twist)
    max_twist = np.max([(abs(s.v), abs(s.omega)) for s in segments], axis=0)
    assert np.all(twist <= max_twist * (1 + 1e-9))


@given(_segments, _start)
def test_end_equals_the_end_of_the_exact_arcs(segments: list[Segment], start: tuple[float, float, float]) -> None:
    trajectory = time_segments(segments, LIMITS, name="test", start=start)
    expected: FloatArray = np.array(start)
    for segment in segments:
        expected = pose_kinematics.integrate_pose(expected, segment.v, segment.omega, segment.duration)
    sample = trajectory.sample([0.0, trajectory.duration])
    np.testing.assert_allclose(sample.pose, np.array([start, expected]), rtol=0, atol=1e-11)
    assert sample.arc_length[1] == pytest.approx(sum(abs(s.v) * s.duration for s in segments), abs=1e-12)


@given(_segments, _start)
def test_twist_integrates_to_pose_and_arc_length(segments: list[Segment], start: tuple[float, float, float]) -> None:
    trajectory = time_segments(segments, LIMITS, name="test", start=start)
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=4) < 1e-9


@given(_segments)
def test_arc_length_never_decreases_and_the_robot_rests_beyond_the_ends(segments: list[Segment]) -> None:
    trajectory = time_segments(segments, LIMITS, name="test")
    arc_length = trajectory.sample(np.linspace(-1, trajectory.duration + 1, 2000)).arc_length
    assert np.all(np.diff(arc_length) >= -1e-14)
    assert_holds_its_ends(trajectory)


# Duration: length over cruise speed, plus cruise speed over acceleration for each part between two stops.
@pytest.mark.parametrize(
    ("name", "duration", "end", "length"),
    [
        ("circle", 4 * np.pi + 0.5, (0.0, 0.0, 2 * np.pi), 2 * np.pi),
        ("square", 4 * (2 + 0.5 + np.pi / 2 + 0.5), (0.0, 0.0, 2 * np.pi), 4.0),
        ("s", 4 * np.pi + 3 * 0.5, (4.0, 0.0, 0.0), 2 * np.pi),
        ("cane", 4 + 0.5 + np.pi / 0.7 + 0.5, (2.0, 2 * 0.5 / 0.7, np.pi), 2 + np.pi * 0.5 / 0.7),
    ],
)
def test_built_in_trajectories_end_at_the_ends_of_exact_arcs(
    name: str, duration: float, end: tuple[float, float, float], length: float
) -> None:
    trajectory = load_trajectory(name)
    assert isinstance(trajectory, Reference)
    assert trajectory.name == name
    assert trajectory.duration == pytest.approx(duration, rel=1e-14)
    sample = trajectory.sample([0.0, trajectory.duration])
    np.testing.assert_allclose(sample.pose, [(0, 0, 0), end], rtol=0, atol=1e-14)
    assert sample.arc_length[1] == pytest.approx(length, rel=1e-14)
    assert np.all(largest_shares(trajectory, TrajectoryLimits.of_robot()) <= 1 + 1e-8)


def test_segments_of_equal_curvature_are_joined_without_a_stop() -> None:
    trajectory = lay((0.5, 0.25, 2.0), (1.0, 0.5, 2.0), (0.4, 0.2, 2.0))
    speed_up, slow_down = 0.5, 0.4
    v = trajectory.sample(np.linspace(speed_up, trajectory.duration - slow_down, 500)).twist[:, 0]
    assert v.min() == pytest.approx(0.4, abs=1e-12)
    assert v.max() == pytest.approx(1.0, abs=1e-12)


@st.composite
def winding_waypoints(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Draw two to six points; each leg turns by at most 1.2 rad relative to the previous leg."""
    scale = draw(st.floats(0.3, 5.0))
    legs = draw(st.lists(st.tuples(st.floats(0.5, 1.5), st.floats(-1.2, 1.2)), min_size=1, max_size=5))
    heading = np.cumsum([turn for _, turn in legs])
    lengths = scale * np.array([length for length, _ in legs])
    steps = lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return [(0.0, 0.0), *map(tuple, np.cumsum(steps, axis=0).tolist())]


def violates_limits(
    squared_speed: FloatArray, lengths: FloatArray, curvature: FloatArray, curvature_rate: FloatArray, cruise: float
) -> bool:
    """Return True if squared speeds at the ends of the pieces violate a limit by more than rounding."""
    max_square = np.maximum(squared_speed[:-1], squared_speed[1:])
    acceleration = np.abs(np.diff(squared_speed)) / (2 * lengths)
    yaw_acceleration = curvature_rate * max_square + curvature * acceleration
    return bool(
        np.any(acceleration > LIMITS.v_acceleration * (1 + 1e-9))
        or np.any(yaw_acceleration > LIMITS.omega_acceleration * (1 + 1e-9))
        or np.any(curvature**2 * max_square > LIMITS.omega**2 * (1 + 1e-9))
        or np.any(max_square > cruise**2 * (1 + 1e-9))
    )


_piece = st.tuples(st.floats(0.01, 0.5), st.floats(0.0, 20.0), st.floats(0.0, 50.0))


@given(st.lists(_piece, min_size=2, max_size=12), st.floats(0.1, 1.5))
def test_speeds_along_a_path_are_the_maximum_within_every_limit(
    pieces: list[tuple[float, float, float]], cruise: float
) -> None:
    lengths, curvature, curvature_rate = np.array(pieces).T
    squared_speed = squared_speeds(lengths, curvature, curvature_rate, LIMITS, cruise)
    assert squared_speed[0] == squared_speed[-1] == 0
    assert np.all(squared_speed[1:-1] > 0)
    assert not violates_limits(squared_speed, lengths, curvature, curvature_rate, cruise)
    for node in range(1, squared_speed.size - 1):
        raised = squared_speed.copy()
        raised[node] *= 1 + 1e-5
        assert violates_limits(raised, lengths, curvature, curvature_rate, cruise)


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_bounds_of_each_piece_cover_its_curvature(waypoints: list[tuple[float, float]]) -> None:
    path = smooth_path(np.array(waypoints), "test")
    change = np.abs(np.diff(path.curvature)) / path.lengths
    max_rate = path.bend_change.max() + 1e-9
    assert np.all(path.bend >= np.abs(path.curvature[1:]))
    # The curvature is smooth between waypoints: the mean slope over one of 400 pieces is near its maximum slope.
    np.testing.assert_allclose(path.bend_change, change, rtol=0, atol=0.1 * max_rate)
    middle = (path.curvature[1:] + path.curvature[:-1]) / 2
    np.testing.assert_allclose(np.diff(path.heading) / path.lengths, middle, atol=1e-3 * np.abs(path.bend).max() + 1e-9)


def test_slalom_reaches_the_limits_without_exceeding_them() -> None:
    trajectory = time_waypoints([(0, 0), (0.5, 0.5), (1, 0), (1.5, -0.5), (2, 0), (6, 0)], LIMITS, name="test")
    shares = largest_shares(trajectory, LIMITS)
    assert np.all(shares <= 1 + 1e-3), shares
    assert shares[0] > 0.99
    assert shares[2] > 0.99
    assert shares[3] > 0.95


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_random_paths_satisfy_every_limit_within_one_percent(waypoints: list[tuple[float, float]]) -> None:
    shares = largest_shares(time_waypoints(waypoints, LIMITS, name="test"), LIMITS)
    assert np.all(shares <= 1.01), shares


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_random_paths_pass_their_waypoints_and_agree_with_their_twist(waypoints: list[tuple[float, float]]) -> None:
    trajectory = time_waypoints(waypoints, LIMITS, name="test", max_deviation=None)
    path = trajectory.sample(trajectory.breaks).pose[:, :2]
    gaps = np.hypot(*(path[:, None, :] - np.array(waypoints)).transpose(2, 0, 1)).min(axis=0)
    assert gaps.max() < 1e-9
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=1) < 1e-5
    assert np.all(np.diff(trajectory.sample(np.linspace(0, trajectory.duration, 3000)).arc_length) >= 0)
    assert_holds_its_ends(trajectory)


def test_straight_line_takes_the_shortest_time() -> None:
    trajectory = time_waypoints([(0, 0), (1, 1), (3, 3)], LIMITS, name="test")
    length = np.hypot(3, 3)
    assert trajectory.duration == pytest.approx(length / 1.5 + 1.5 / 1.0, rel=1e-3)
    assert trajectory.sample([trajectory.duration]).arc_length[0] == pytest.approx(length)
    np.testing.assert_allclose(trajectory.sample(np.linspace(0, 4, 50)).pose[:, 2], np.pi / 4, atol=1e-12)
