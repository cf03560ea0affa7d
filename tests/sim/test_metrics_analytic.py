"""Metrics against motions whose errors are known on paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_parts import ConstantTwist, ElbowReference, run_along

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.pose import integrate_pose

TIMES = np.arange(0.0, 10.0 + 1e-9, 0.02)
COARSE = TIMES[::10]
CIRCLE = ConstantTwist(v=0.5, omega=0.5, duration=10.0)


def shifted_left(pose: FloatArray, offset: float) -> FloatArray:
    """Poses moved sideways in their own frame."""
    return pose + offset * np.column_stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2]), np.zeros(len(pose))])


@given(offset=st.floats(-0.2, 0.2))
def test_a_constant_offset_across_a_circle_is_the_lateral_error(offset: float) -> None:
    run = run_along(CIRCLE, shifted_left(CIRCLE.sample(COARSE).pose, offset), [0.5, 0.0, 0.5], COARSE)
    # The path is a polyline with 5 mm spacing: at most 3.2 um inside the circle of 1 m.
    assert run.errors.lateral == pytest.approx(np.full(len(COARSE), offset), abs=3.2e-6)
    assert run.metrics.lateral_rmse_m == pytest.approx(abs(offset), abs=3.2e-6)
    assert run.metrics.lateral_p95_m == pytest.approx(abs(offset), abs=3.2e-6)
    assert run.metrics.position_rmse_m == pytest.approx(abs(offset), abs=1e-12)
    assert run.metrics.position_std_m == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.heading_rmse_rad == pytest.approx(0.0, abs=1e-12)


@given(delay=st.floats(0.01, 0.5))
def test_a_delayed_motion_is_off_in_position_and_heading_but_on_the_path(delay: float) -> None:
    late = ConstantTwist(0.5, 0.5, 20.0, start=tuple(integrate_pose([0, 0, 0], 0.5, 0.5, -delay)))
    run = run_along(CIRCLE, late.sample(COARSE).pose, [0.5, 0.0, 0.5], COARSE)
    chord = 2.0 * np.sin(0.5 * delay / 2)
    assert run.metrics.position_rmse_m == pytest.approx(chord, rel=1e-9)
    assert run.metrics.position_max_m == pytest.approx(chord, rel=1e-9)
    assert run.metrics.heading_mean_rad == pytest.approx(0.5 * delay, rel=1e-9)
    # Along the tangent, over the speed.
    assert run.metrics.behind_max_s == pytest.approx(np.sin(0.5 * delay) / 0.5, rel=1e-9)
    on_path = run.time >= delay  # earlier the robot is before the start, where the path goes on straight
    assert np.abs(run.errors.lateral[on_path]).max() < 3.2e-6


def test_heading_errors_are_wrapped_whatever_turn_the_angles_are_on() -> None:
    pose = CIRCLE.sample(TIMES).pose
    wrapped = pose.copy()
    wrapped[:, 2] = np.arctan2(np.sin(pose[:, 2] + 0.1), np.cos(pose[:, 2] + 0.1))
    assert pose[:, 2].max() > np.pi
    metrics = run_along(CIRCLE, wrapped, [0.5, 0.0, 0.5], TIMES).metrics
    assert metrics.heading_rmse_rad == pytest.approx(0.1, abs=1e-12)
    assert metrics.heading_max_rad == pytest.approx(0.1, abs=1e-12)


def test_side_slip_shows_in_the_course_and_not_in_the_heading() -> None:
    run = run_along(CIRCLE, CIRCLE.sample(TIMES).pose, [0.5, -0.05, 0.5], TIMES)
    assert run.metrics.heading_rmse_rad == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.course_rmse_rad == pytest.approx(np.arctan2(0.05, 0.5), rel=1e-12)


def test_holding_the_path_against_side_slip_shows_in_the_heading_and_not_in_the_course() -> None:
    slip = 0.08
    pose = CIRCLE.sample(TIMES).pose + np.array([0.0, 0.0, slip])
    run = run_along(CIRCLE, pose, [0.5 * np.cos(slip), -0.5 * np.sin(slip), 0.5], TIMES)
    assert run.metrics.heading_rmse_rad == pytest.approx(slip, rel=1e-12)
    assert run.metrics.course_rmse_rad == pytest.approx(0.0, abs=1e-12)


def test_driving_backwards_as_the_reference_does_is_no_course_error() -> None:
    back = ConstantTwist(v=-0.3, omega=0.2, duration=10.0)
    run = run_along(back, back.sample(TIMES).pose, [-0.3, 0.0, 0.2], TIMES)
    assert run.metrics.course_rmse_rad == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.lateral_max_m < 3.2e-6


def test_course_error_is_against_the_tangent_where_the_reference_is() -> None:
    """A robot that keeps to the circle half a second behind differs in course by the turn of half a second."""
    circle = ConstantTwist(v=0.5, omega=0.5, duration=4.0)
    times = np.arange(25, 200) * 0.02
    run = run_along(circle, circle.sample(times - 0.5).pose, [0.5, 0.0, 0.5], times)
    np.testing.assert_allclose(run.errors.course, -0.25, atol=1e-12)
    assert np.abs(run.errors.lateral).max() < 1e-5


def test_no_course_error_is_taken_while_the_robot_or_the_reference_stands() -> None:
    spot = ConstantTwist(v=0.0, omega=1.0, duration=10.0)
    turning = run_along(spot, spot.sample(TIMES).pose, [0.2, 0.1, 1.0], TIMES)
    standing = run_along(CIRCLE, CIRCLE.sample(TIMES).pose, [0.03, 0.03, 0.5], TIMES)
    assert np.isnan(turning.metrics.course_rmse_rad)
    assert np.isnan(standing.errors.course).all()


def test_turning_on_the_spot_measures_the_distance_across() -> None:
    spot = ConstantTwist(v=0.0, omega=1.0, duration=10.0)
    off = run_along(spot, spot.sample(TIMES).pose + np.array([0.0, 0.04, 0.0]), [0.0, 0.0, 1.0], TIMES)
    assert off.metrics.lateral_max_m == pytest.approx(0.04, abs=1e-12)


def test_overshooting_a_corner_is_a_lateral_error_and_lying_on_either_leg_is_none() -> None:
    elbow = ElbowReference()
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
    pose = elbow.sample(times).pose
    pose[2:5, 0] += 0.03
    lateral = run_along(elbow, pose, [0.5, 0.0, 0.0], times).errors.lateral
    assert lateral == pytest.approx([0.0, 0.0, -0.03, -0.03, -0.03, 0.0], abs=1e-12)


def test_a_path_that_crosses_itself_is_not_mistaken_for_its_other_branch() -> None:
    """After three quarters of a turn the robot is far off its circle but near the straight start."""
    circle = ConstantTwist(v=0.5, omega=0.5, duration=4 * np.pi)
    times = np.arange(0.0, 4 * np.pi, 0.02)
    pose = circle.sample(times).pose
    half = np.abs(times - 2 * np.pi) < 0.5
    pose[half] = [0.0, 0.0, 0.0]
    run = run_along(circle, pose, [0.5, 0.0, 0.5], times)
    assert np.abs(run.errors.lateral[half]).min() > 1.0


def test_being_ahead_on_a_straight_line_is_no_lateral_error_even_beyond_its_end() -> None:
    line = ConstantTwist(v=0.5, omega=0.0, duration=10.0, start=(1.0, 2.0, 0.3))
    ahead = line.sample(TIMES).pose + 0.1 * np.array([np.cos(0.3), np.sin(0.3), 0.0])
    metrics = run_along(line, ahead, [0.5, 0.0, 0.0], TIMES).metrics
    assert metrics.lateral_max_m == pytest.approx(0.0, abs=1e-9)
    assert metrics.position_mean_m == pytest.approx(0.1, rel=1e-9)


def test_the_band_counts_the_share_of_ticks_inside_it() -> None:
    line = ConstantTwist(v=0.5, omega=0.0, duration=10.0)
    pose = line.sample(TIMES[:400]).pose
    pose[:100, 1] = 0.0501
    pose[100:200, 1] = -0.0499
    metrics = run_along(line, pose, [0.5, 0.0, 0.0], TIMES[:400]).metrics
    assert metrics.in_band_percent == pytest.approx(75.0)
    assert metrics.lateral_mae_m == pytest.approx(0.025, abs=1e-9)


@given(
    x=st.floats(-5, 5),
    y=st.floats(-5, 5),
    theta=st.floats(-10, 10),
    seed=st.integers(0, 100),
)
def test_moving_the_whole_scene_changes_no_metric(x: float, y: float, theta: float, seed: int) -> None:
    offset = 0.03 * np.random.default_rng(seed).standard_normal((len(COARSE), 3))
    moved_circle = ConstantTwist(0.5, 0.5, 10.0, start=(x, y, theta))
    rotation = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    moved_offset = np.column_stack([offset[:, :2] @ rotation.T, offset[:, 2]])
    here = run_along(CIRCLE, CIRCLE.sample(COARSE).pose + offset, [0.5, 0.01, 0.5], COARSE).metrics
    there = run_along(moved_circle, moved_circle.sample(COARSE).pose + moved_offset, [0.5, 0.01, 0.5], COARSE).metrics
    for name in ("position_rmse_m", "position_std_m", "heading_max_rad", "course_rmse_rad", "lateral_rmse_m"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-6), name
