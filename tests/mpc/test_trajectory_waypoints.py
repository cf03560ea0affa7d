"""Smooth timed paths through waypoints."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trajectory_checks import assert_holds_its_ends, largest_integration_gap, largest_shares

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits, load_trajectory
from diffdrive_mpc.mpc.trajectories.path_timing import squared_speeds
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.waypoints import lay_waypoints

LIMITS = TrajectoryLimits(v=1.5, omega=2.0, v_acceleration=1.0, omega_acceleration=2.0)


@st.composite
def winding_waypoints(draw: st.DrawFn) -> list[tuple[float, float]]:
    """Two to six points; each leg turns by at most 1.2 rad against the one before."""
    scale = draw(st.floats(0.3, 5.0))
    legs = draw(st.lists(st.tuples(st.floats(0.5, 1.5), st.floats(-1.2, 1.2)), min_size=1, max_size=5))
    heading = np.cumsum([turn for _, turn in legs])
    lengths = scale * np.array([length for length, _ in legs])
    steps = lengths[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    return [(0.0, 0.0), *map(tuple, np.cumsum(steps, axis=0).tolist())]


def broken_limits(
    square: FloatArray, lengths: FloatArray, bend: FloatArray, bend_change: FloatArray, cruise: float
) -> bool:
    """Whether squared speeds at the ends of the pieces of a path break any limit by more than rounding."""
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
def test_speeds_along_a_path_keep_every_limit_and_none_can_be_raised(
    pieces: list[tuple[float, float, float]], cruise: float
) -> None:
    lengths, bend, bend_change = np.array(pieces).T
    square = squared_speeds(lengths, bend, bend_change, LIMITS, cruise)
    assert square[0] == square[-1] == 0
    assert np.all(square[1:-1] > 0)
    assert not broken_limits(square, lengths, bend, bend_change, cruise)
    for node in range(1, square.size - 1):
        raised = square.copy()
        raised[node] *= 1 + 1e-5
        assert broken_limits(raised, lengths, bend, bend_change, cruise)


@settings(max_examples=25, deadline=None)
@given(winding_waypoints())
def test_bounds_of_each_piece_are_those_of_its_curvature(waypoints: list[tuple[float, float]]) -> None:
    path = smooth_path(np.array(waypoints), "test")
    change = np.abs(np.diff(path.curvature)) / path.lengths
    largest = path.bend_change.max() + 1e-9
    assert np.all(path.bend >= np.abs(path.curvature[1:]))
    # The curvature is smooth between waypoints, so over one of 400 pieces its mean slope is near its largest.
    np.testing.assert_allclose(path.bend_change, change, rtol=0, atol=0.1 * largest)
    middle = (path.curvature[1:] + path.curvature[:-1]) / 2
    np.testing.assert_allclose(np.diff(path.heading) / path.lengths, middle, atol=1e-3 * np.abs(path.bend).max() + 1e-9)


def test_a_slalom_is_driven_at_the_limits_but_not_beyond() -> None:
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
    trajectory = lay_waypoints(waypoints, LIMITS, name="test")
    path = trajectory.sample(trajectory.breaks).pose[:, :2]
    gaps = np.hypot(*(path[:, None, :] - np.array(waypoints)).transpose(2, 0, 1)).min(axis=0)
    assert gaps.max() < 1e-9
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=1) < 1e-5
    assert np.all(np.diff(trajectory.sample(np.linspace(0, trajectory.duration, 3000)).arc_length) >= 0)
    assert_holds_its_ends(trajectory)


def test_curvature_is_continuous() -> None:
    trajectory = lay_waypoints([(0, 0), (1, 0), (2, 1), (1, 2)], LIMITS, name="test")
    v, omega = trajectory.sample(np.linspace(0.3, trajectory.duration - 0.3, 20000)).twist.T
    assert np.abs(np.diff(omega / v)).max() < 0.01


def test_a_straight_line_takes_the_shortest_time() -> None:
    trajectory = lay_waypoints([(0, 0), (1, 1), (3, 3)], LIMITS, name="test")
    length = np.hypot(3, 3)
    assert trajectory.duration == pytest.approx(length / 1.5 + 1.5 / 1.0, rel=1e-3)
    assert trajectory.sample([trajectory.duration]).arc_length[0] == pytest.approx(length)
    np.testing.assert_allclose(trajectory.sample(np.linspace(0, 4, 50)).pose[:, 2], np.pi / 4, atol=1e-12)


def test_a_path_around_the_origin_keeps_its_heading_unwrapped() -> None:
    angles = np.linspace(0, 4 * np.pi, 33)
    trajectory = lay_waypoints(list(zip(np.cos(angles), np.sin(angles), strict=True)), LIMITS, name="test")
    theta = trajectory.sample([0.0, trajectory.duration]).pose[:, 2]
    # The first and the last of the 32 chords differ by 31 steps; the arcs beyond their middles add one step at most.
    assert 31 * np.pi / 8 < theta[1] - theta[0] < 32 * np.pi / 8


def test_waypoints_from_a_file_are_driven_at_their_speed(tmp_path: Path) -> None:
    path = tmp_path / "tour.yaml"
    path.write_text("name: tour\nwaypoints: [[0, 0], [2, 0], [4, 1]]\nspeed: 0.4\n", encoding="utf-8")
    trajectory = load_trajectory(path)
    assert trajectory.name == "tour"
    v = trajectory.sample(np.linspace(0, trajectory.duration, 2000)).twist[:, 0]
    assert v.max() == pytest.approx(0.4, rel=1e-4)
    assert np.median(v) == pytest.approx(0.4, rel=1e-4)
