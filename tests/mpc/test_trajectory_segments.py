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
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.waypoints import lay_waypoints

LIMITS = TrajectoryLimits(v=1.5, omega=2.0, v_acceleration=1.0, omega_acceleration=2.0)

_v = st.one_of(st.just(0.0), st.just(0.5), st.just(-0.5), st.floats(-1.5, 1.5))
_omega = st.one_of(st.just(0.0), st.just(0.5), st.just(-1.0), st.floats(-2.0, 2.0))
_segments = st.lists(st.builds(Segment, v=_v, omega=_omega, duration=st.floats(0.02, 3.0)), min_size=1, max_size=6)
_start = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-4, 4))


def lay(*twists: tuple[float, float, float]) -> ArcTrajectory:
    segments = [Segment(v=v, omega=omega, duration=duration) for v, omega, duration in twists]
    return lay_segments(segments, LIMITS, name="test")


@given(_segments)
def test_random_sequences_respect_every_limit(segments: list[Segment]) -> None:
    shares = largest_shares(lay_segments(segments, LIMITS, name="test"), LIMITS)
    assert np.all(shares <= 1 + 1e-8), shares


@given(_segments)
def test_no_segment_is_driven_faster_than_its_own_twist(segments: list[Segment]) -> None:
    trajectory = lay_segments(segments, LIMITS, name="test")
    twist = np.abs(trajectory.sample(np.linspace(0, trajectory.duration, 500)).twist)
    slowest_cruise = np.max([(abs(s.v), abs(s.omega)) for s in segments], axis=0)
    assert np.all(twist <= slowest_cruise * (1 + 1e-9))


@given(_segments, _start)
def test_end_is_the_product_of_the_exact_arcs(segments: list[Segment], start: tuple[float, float, float]) -> None:
    trajectory = lay_segments(segments, LIMITS, name="test", start=start)
    expected: FloatArray = np.array(start)
    for segment in segments:
        expected = pose_kinematics.integrate_pose(expected, segment.v, segment.omega, segment.duration)
    sample = trajectory.sample([0.0, trajectory.duration])
    np.testing.assert_allclose(sample.pose, np.array([start, expected]), rtol=0, atol=1e-11)
    assert sample.arc_length[1] == pytest.approx(sum(abs(s.v) * s.duration for s in segments), abs=1e-12)


@given(_segments, _start)
def test_twist_integrates_to_pose_and_arc_length(segments: list[Segment], start: tuple[float, float, float]) -> None:
    trajectory = lay_segments(segments, LIMITS, name="test", start=start)
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=4) < 1e-9


@given(_segments)
def test_arc_length_never_falls_and_ends_hold(segments: list[Segment]) -> None:
    trajectory = lay_segments(segments, LIMITS, name="test")
    arc_length = trajectory.sample(np.linspace(-1, trajectory.duration + 1, 2000)).arc_length
    assert np.all(np.diff(arc_length) >= -1e-14)
    assert_holds_its_ends(trajectory)


# Length over cruise speed, plus cruise speed over acceleration for each run between two stops.
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


def test_equal_curvature_is_joined_without_a_stop() -> None:
    trajectory = lay((0.5, 0.25, 2.0), (1.0, 0.5, 2.0), (0.4, 0.2, 2.0))
    speed_up, slow_down = 0.5, 0.4
    inside = trajectory.sample(np.linspace(speed_up, trajectory.duration - slow_down, 500)).twist[:, 0]
    assert inside.min() == pytest.approx(0.4, abs=1e-12)
    assert inside.max() == pytest.approx(1.0, abs=1e-12)


@st.composite
def winding_waypoints(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Draw two to six points; each leg turns by at most 1.2 rad against the previous one."""
    scale = draw(st.floats(0.3, 5.0))
    legs = draw(st.lists(st.tuples(st.floats(0.5, 1.5), st.floats(-1.2, 1.2)), min_size=1, max_size=5))
    heading = np.cumsum([turn for _, turn in legs])
    lengths = scale * np.array([length for length, _ in legs])
    steps = lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return [(0.0, 0.0), *map(tuple, np.cumsum(steps, axis=0).tolist())]


def violates_limits(
    square: FloatArray, lengths: FloatArray, bend: FloatArray, bend_change: FloatArray, cruise: float
) -> bool:
    """Return True if squared speeds at the ends of the pieces violate a limit by more than rounding."""
    faster = np.maximum(square[:-1], square[1:])
    acceleration = np.abs(np.diff(square)) / (2 * lengths)
    yaw_acceleration = bend_change * faster + bend * acceleration
    return bool(
        np.any(acceleration > LIMITS.v_acceleration * (1 + 1e-9))
        or np.any(yaw_acceleration > LIMITS.omega_acceleration * (1 + 1e-9))
        or np.any(bend**2 * faster > LIMITS.omega**2 * (1 + 1e-9))
        or np.any(faster > cruise**2 * (1 + 1e-9))
    )


_piece = st.tuples(st.floats(0.01, 0.5), st.floats(0.0, 20.0), st.floats(0.0, 50.0))


@given(st.lists(_piece, min_size=2, max_size=12), st.floats(0.1, 1.5))
def test_speeds_along_a_path_satisfy_every_limit_and_none_can_be_raised(
    pieces: list[tuple[float, float, float]], cruise: float
) -> None:
    lengths, bend, bend_change = np.array(pieces).T
    square = squared_speeds(lengths, bend, bend_change, LIMITS, cruise)
    assert square[0] == square[-1] == 0
    assert np.all(square[1:-1] > 0)
    assert not violates_limits(square, lengths, bend, bend_change, cruise)
    for node in range(1, square.size - 1):
        raised = square.copy()
        raised[node] *= 1 + 1e-5
        assert violates_limits(raised, lengths, bend, bend_change, cruise)


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_bounds_of_each_piece_cover_its_curvature(waypoints: list[tuple[float, float]]) -> None:
    path = smooth_path(np.array(waypoints), "test")
    change = np.abs(np.diff(path.curvature)) / path.lengths
    largest = path.bend_change.max() + 1e-9
    assert np.all(path.bend >= np.abs(path.curvature[1:]))
    # The curvature is smooth between waypoints: over one of 400 pieces the mean slope is near the maximum slope.
    np.testing.assert_allclose(path.bend_change, change, rtol=0, atol=0.1 * largest)
    middle = (path.curvature[1:] + path.curvature[:-1]) / 2
    np.testing.assert_allclose(np.diff(path.heading) / path.lengths, middle, atol=1e-3 * np.abs(path.bend).max() + 1e-9)


def test_slalom_reaches_the_limits_without_exceeding_them() -> None:
    trajectory = lay_waypoints([(0, 0), (0.5, 0.5), (1, 0), (1.5, -0.5), (2, 0), (6, 0)], LIMITS, name="test")
    shares = largest_shares(trajectory, LIMITS)
    assert np.all(shares <= 1 + 1e-3), shares
    assert shares[0] > 0.99
    assert shares[2] > 0.99
    assert shares[3] > 0.95


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_random_paths_respect_every_limit_within_one_percent(waypoints: list[tuple[float, float]]) -> None:
    shares = largest_shares(lay_waypoints(waypoints, LIMITS, name="test"), LIMITS)
    assert np.all(shares <= 1.01), shares


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_random_paths_pass_their_waypoints_and_agree_with_their_twist(waypoints: list[tuple[float, float]]) -> None:
    trajectory = lay_waypoints(waypoints, LIMITS, name="test", max_deviation=None)
    path = trajectory.sample(trajectory.breaks).pose[:, :2]
    gaps = np.hypot(*(path[:, None, :] - np.array(waypoints)).transpose(2, 0, 1)).min(axis=0)
    assert gaps.max() < 1e-9
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=1) < 1e-5
    assert np.all(np.diff(trajectory.sample(np.linspace(0, trajectory.duration, 3000)).arc_length) >= 0)
    assert_holds_its_ends(trajectory)


def test_straight_line_takes_the_shortest_time() -> None:
    trajectory = lay_waypoints([(0, 0), (1, 1), (3, 3)], LIMITS, name="test")
    length = np.hypot(3, 3)
    assert trajectory.duration == pytest.approx(length / 1.5 + 1.5 / 1.0, rel=1e-3)
    assert trajectory.sample([trajectory.duration]).arc_length[0] == pytest.approx(length)
    np.testing.assert_allclose(trajectory.sample(np.linspace(0, 4, 50)).pose[:, 2], np.pi / 4, atol=1e-12)
