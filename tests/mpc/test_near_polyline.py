"""Paths through waypoints near their polyline; an independent function measures the distance at dense points."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from trajectory_checks import largest_shares

from diffdrive_mpc import ConfigError, Trajectory, load_trajectory
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.smooth_path import smooth_path
from diffdrive_mpc.mpc.trajectories.waypoints import MAX_DEVIATION, time_waypoints

LIMITS = TrajectoryLimits.of_robot()
CHORD = 0.7 / np.sqrt(2)
AISLE = [(0, 0), (10, 0), (10 + CHORD, CHORD), (10 + CHORD, 10 + CHORD), (10, 10 + 2 * CHORD), (0, 10 + 2 * CHORD)]
SQUARE = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0)]
ZIGZAG = [(0.5 * i, 0.5 * (i % 2)) for i in range(17)]
ANGLES = np.arange(0.0, 2 * np.pi, 0.1)
CIRCLE = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
SEEDS = range(55_000, 55_100)
"""Seeds of polylines that were not used in the development of the method."""


def distances(points: FloatArray, polyline: FloatArray) -> FloatArray:
    """Return the distance of each point from its nearest leg."""
    nearest = np.full(len(points), np.inf)
    for start, end in pairwise(polyline):
        leg = end - start
        share = np.clip((points - start) @ leg / (leg @ leg), 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(*(points - start - share[:, None] * leg).T))
    return nearest


def dense_points(trajectory: Trajectory, step: float = 0.002) -> FloatArray:
    count = int(trajectory.sample([trajectory.duration]).arc_length[0] / step) + 4000
    return trajectory.sample(np.linspace(0.0, trajectory.duration, count)).pose[:, :2]


def random_polyline(seed: int) -> FloatArray:
    """Return 4 to 12 points with legs of 0.3 to 10 m and turns of up to 110 degrees."""
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 12))
    heading = np.cumsum(random.uniform(-1.92, 1.92, count))
    legs = np.exp(random.uniform(np.log(0.3), np.log(10.0), count))
    return np.cumsum(
        np.vstack([[0.0, 0.0], legs[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])]), axis=0
    )


@pytest.mark.parametrize("points", [AISLE, SQUARE, ZIGZAG], ids=["aisle", "square", "every half metre"])
@pytest.mark.parametrize("timing", ["stop", "smooth"])
def test_path_stays_near_its_polyline_within_all_limits(points, timing):
    spline = time_waypoints(points, LIMITS, name="spline", timing=timing, max_deviation=None)
    assert distances(dense_points(spline), np.array(points, float)).max() > 0.05
    trajectory = time_waypoints(points, LIMITS, name="near", timing=timing)
    distance = distances(dense_points(trajectory), np.array(points, float)).max()
    assert distance <= MAX_DEVIATION
    # The reported deviation equals the measured deviation except for sampling.
    assert trajectory.drawn_distance(trajectory.breaks).max() == pytest.approx(distance, rel=0.02)
    assert np.all(largest_shares(trajectory, LIMITS) <= 1.01)


def test_points_on_a_smooth_curve_give_the_unlimited_spline():
    near, spline = (smooth_path(CIRCLE, "circle", max_deviation=limit) for limit in (0.05, None))
    assert np.array_equal(near.points, spline.points)
    middle = near.curvature[len(near.curvature) // 10 : -len(near.curvature) // 10]
    assert middle == pytest.approx(1.0, abs=0.01)


def test_straight_leg_does_not_affect_the_smoothness_at_dense_points():
    points = np.vstack([[[1.0, -10.0]], CIRCLE])
    path = smooth_path(points, "hook", max_deviation=0.05)
    assert distances(path.points, points).max() <= 0.05
    assert np.abs(path.curvature).max() < 2.0


def test_paths_of_random_polylines_stay_near_and_pass_their_points():
    for seed in SEEDS:
        points = random_polyline(seed)
        path = smooth_path(points, f"seed {seed}", max_deviation=0.05)
        assert distances(path.points, points).max() <= 0.05, seed
        assert np.isfinite(path.curvature).all() and np.abs(path.curvature).max() < 50.0, seed
        assert np.isfinite(path.bend_change).all(), seed
        gaps = [np.hypot(*(path.points - point).T).min() for point in points]
        assert max(gaps) <= 0.05, seed
        # Heading and curvature are continuous: between nodes they change within their bounds.
        assert (np.abs(np.diff(path.heading)) <= path.bend * path.lengths * 1.02 + 1e-9).all(), seed
        assert (np.abs(np.diff(path.curvature)) <= path.bend_change * path.lengths * 1.05 + 1e-9).all(), seed


def test_deviation_from_a_file_is_used_and_errors_for_hairpins_name_its_key(tmp_path: Path):
    file = tmp_path / "square.yaml"
    file.write_text(f"waypoints: {[list(point) for point in SQUARE]}\nmax_deviation: 0.2\n")
    trajectory = load_trajectory(file)
    distance = distances(dense_points(trajectory), np.array(SQUARE, float)).max()
    assert 0.05 < distance <= 0.2
    assert trajectory.remark == (
        f"trajectory 'square': its path is up to {distance:.3f} m from the polyline of its waypoints; "
        "errors refer to its path"
    )
    with pytest.raises(ConfigError, match=r"waypoints.1 and waypoints.2; .* or split the path there, .* turns back$"):
        time_waypoints([(0, 0), (4, 0), (0, 0.1)], LIMITS, name="hairpin")
    with pytest.raises(ConfigError, match="max_deviation = 0 m; give a positive number"):
        Trajectory.from_waypoints(SQUARE, max_deviation=0)


@pytest.mark.parametrize(("leg", "degrees"), [(0.5, 140), (0.5, 144), (1, 148), (1, 156), (3, 152)])
def test_errors_for_tight_turns_offer_a_larger_deviation_only_if_it_is_sufficient(leg: float, degrees: float):
    turn = np.radians(degrees)
    points = np.array([(0, 0), (leg, 0), (leg + leg * np.cos(turn), leg * np.sin(turn))])
    with pytest.raises(ConfigError, match="turns with a radius below") as error:
        smooth_path(points, "turn", max_deviation=0.02)
    if "or raise max_deviation = 0.02" in str(error.value):
        smooth_path(points, "turn", max_deviation=10.0)
    else:
        with pytest.raises(ConfigError, match="to round the turn$"):
            smooth_path(points, "turn", max_deviation=10.0)
