"""Metrics compared with known results, their ticks, and the projection of a robot onto its path."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_parts import ConstantTwist, ElbowReference, FeedForward, KinematicPlant, SlowController, run_along

from diffdrive_mpc import integrate_pose, load_trajectory
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.metrics import BRAKING_MODES, FALLBACK_MODES
from diffdrive_mpc.sim.metrics.path_projection import Polyline
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from studies.tracking.measured import steady_arc_lateral, steady_arcs

TIMES = np.arange(0.0, 10.0 + 1e-9, 0.02)
COARSE = TIMES[::10]
CIRCLE = ConstantTwist(v=0.5, omega=0.5, duration=10.0)


def shift_left(pose: FloatArray, offset: float | FloatArray) -> FloatArray:
    """Shift poses to the left in their frame."""
    return pose + offset * np.column_stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2]), np.zeros(len(pose))])


@given(offset=st.floats(-0.2, 0.2))
def test_constant_offset_across_a_circle_is_the_lateral_error(offset: float) -> None:
    run = run_along(CIRCLE, shift_left(CIRCLE.sample(COARSE).pose, offset), [0.5, 0.0, 0.5], COARSE)
    # The path is a polyline with 5 mm spacing: at most 3.2 um inside the circle of 1 m.
    assert run.errors.lateral == pytest.approx(np.full(len(COARSE), offset), abs=3.2e-6)
    assert run.metrics.lateral_rmse_m == pytest.approx(abs(offset), abs=3.2e-6)
    assert run.metrics.lateral_p95_m == pytest.approx(abs(offset), abs=3.2e-6)
    assert run.metrics.position_rmse_m == pytest.approx(abs(offset), abs=1e-12)
    assert run.metrics.position_std_m == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.heading_rmse_rad == pytest.approx(0.0, abs=1e-12)


@given(delay=st.floats(0.01, 0.5))
def test_delayed_motion_has_position_and_heading_errors_but_no_lateral_error(delay: float) -> None:
    delayed = ConstantTwist(0.5, 0.5, 20.0, start=tuple(integrate_pose([0, 0, 0], 0.5, 0.5, -delay)))
    run = run_along(CIRCLE, delayed.sample(COARSE).pose, [0.5, 0.0, 0.5], COARSE)
    chord = 2.0 * np.sin(0.5 * delay / 2)
    assert run.metrics.position_rmse_m == pytest.approx(chord, rel=1e-9)
    assert run.metrics.position_max_m == pytest.approx(chord, rel=1e-9)
    assert run.metrics.heading_mean_rad == pytest.approx(0.5 * delay, rel=1e-9)
    # The distance along the tangent, over the speed.
    assert run.metrics.behind_max_s == pytest.approx(np.sin(0.5 * delay) / 0.5, rel=1e-9)
    on_path = run.time >= delay  # before that the robot is ahead of the straight start
    assert np.abs(run.errors.lateral[on_path]).max() < 3.2e-6


def test_heading_errors_are_wrapped_for_any_number_of_turns() -> None:
    pose = CIRCLE.sample(TIMES).pose
    wrapped = pose.copy()
    wrapped[:, 2] = np.arctan2(np.sin(pose[:, 2] + 0.1), np.cos(pose[:, 2] + 0.1))
    assert pose[:, 2].max() > np.pi
    metrics = run_along(CIRCLE, wrapped, [0.5, 0.0, 0.5], TIMES).metrics
    assert metrics.heading_rmse_rad == pytest.approx(0.1, abs=1e-12)
    assert metrics.heading_max_rad == pytest.approx(0.1, abs=1e-12)
    assert metrics.course_rmse_rad == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize(
    ("heading", "twist", "course"),
    [(0.0, (0.5, -0.05), np.arctan2(0.05, 0.5)), (0.08, (0.5 * np.cos(0.08), -0.5 * np.sin(0.08)), 0.0)],
)
def test_side_slip_appears_in_the_course_or_in_the_heading_that_compensates_it(heading, twist, course) -> None:
    run = run_along(CIRCLE, CIRCLE.sample(TIMES).pose + [0.0, 0.0, heading], [*twist, 0.5], TIMES)
    assert run.errors.heading == pytest.approx(np.full(len(TIMES), heading), rel=1e-12, abs=1e-12)
    assert run.metrics.course_rmse_rad == pytest.approx(course, rel=1e-12, abs=1e-12)


def test_backward_driving_along_the_reference_has_no_course_error() -> None:
    back = ConstantTwist(v=-0.3, omega=0.2, duration=10.0)
    run = run_along(back, back.sample(TIMES).pose, [-0.3, 0.0, 0.2], TIMES)
    assert run.metrics.course_rmse_rad == pytest.approx(0.0, abs=1e-12)
    assert run.metrics.lateral_max_m < 3.2e-6


def test_course_error_is_relative_to_the_tangent_at_the_reference() -> None:
    """On a circle, a delay of half a second changes the course by the turn in half a second."""
    circle = ConstantTwist(v=0.5, omega=0.5, duration=4.0)
    times = np.arange(25, 200) * 0.02
    run = run_along(circle, circle.sample(times - 0.5).pose, [0.5, 0.0, 0.5], times)
    np.testing.assert_allclose(run.errors.course, -0.25, atol=1e-12)
    assert np.abs(run.errors.lateral).max() < 1e-5


def test_course_error_is_undefined_while_the_robot_or_the_reference_is_at_rest() -> None:
    spot = ConstantTwist(v=0.0, omega=1.0, duration=10.0)
    turning = run_along(spot, spot.sample(TIMES).pose, [0.2, 0.1, 1.0], TIMES)
    standing = run_along(CIRCLE, CIRCLE.sample(TIMES).pose, [0.03, 0.03, 0.5], TIMES)
    assert np.isnan(turning.metrics.course_rmse_rad)
    assert np.isnan(standing.errors.course).all()


def test_lateral_error_of_a_turn_on_the_spot_is_the_distance_across() -> None:
    spot = ConstantTwist(v=0.0, omega=1.0, duration=10.0)
    run = run_along(spot, spot.sample(TIMES).pose + np.array([0.0, 0.04, 0.0]), [0.0, 0.0, 1.0], TIMES)
    assert run.metrics.lateral_max_m == pytest.approx(0.04, abs=1e-12)


def test_overshoot_of_a_corner_is_a_lateral_error_and_a_point_on_either_leg_has_none() -> None:
    elbow = ElbowReference()
    times = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])
    pose = elbow.sample(times).pose
    pose[2:5, 0] += 0.03
    lateral = run_along(elbow, pose, [0.5, 0.0, 0.0], times).errors.lateral
    assert lateral == pytest.approx([0.0, 0.0, -0.03, -0.03, -0.03, 0.0], abs=1e-12)


def test_self_crossing_path_is_not_projected_onto_its_other_branch() -> None:
    """After three quarters of a turn the robot is far off its circle but near the straight start."""
    circle = ConstantTwist(v=0.5, omega=0.5, duration=4 * np.pi)
    times = np.arange(0.0, 4 * np.pi, 0.02)
    pose = circle.sample(times).pose
    is_displaced = np.abs(times - 2 * np.pi) < 0.5
    pose[is_displaced] = [0.0, 0.0, 0.0]
    run = run_along(circle, pose, [0.5, 0.0, 0.5], times)
    assert np.abs(run.errors.lateral[is_displaced]).min() > 1.0


def test_lead_on_a_straight_line_is_not_a_lateral_error_even_beyond_its_end() -> None:
    line = ConstantTwist(v=0.5, omega=0.0, duration=10.0, start=(1.0, 2.0, 0.3))
    ahead = line.sample(TIMES).pose + 0.1 * np.array([np.cos(0.3), np.sin(0.3), 0.0])
    metrics = run_along(line, ahead, [0.5, 0.0, 0.0], TIMES).metrics
    assert metrics.lateral_max_m == pytest.approx(0.0, abs=1e-9)
    assert metrics.position_mean_m == pytest.approx(0.1, rel=1e-9)
    assert metrics.behind_max_s == 0.0


def test_band_share_counts_the_ticks_inside_the_band() -> None:
    line = ConstantTwist(v=0.5, omega=0.0, duration=10.0)
    pose = line.sample(TIMES[:400]).pose
    pose[:100, 1] = 0.0501
    pose[100:200, 1] = -0.0499
    metrics = run_along(line, pose, [0.5, 0.0, 0.0], TIMES[:400]).metrics
    assert metrics.in_band_percent == pytest.approx(75.0)
    assert metrics.lateral_mae_m == pytest.approx(0.025, abs=1e-9)


@given(x=st.floats(-5, 5), y=st.floats(-5, 5), theta=st.floats(-10, 10), seed=st.integers(0, 100))
def test_rigid_motion_of_the_scene_changes_no_metric(x: float, y: float, theta: float, seed: int) -> None:
    offset = 0.03 * np.random.default_rng(seed).standard_normal((len(COARSE), 3))
    moved_circle = ConstantTwist(0.5, 0.5, 10.0, start=(x, y, theta))
    rotation = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    moved_offset = np.column_stack([offset[:, :2] @ rotation.T, offset[:, 2]])
    original = run_along(CIRCLE, CIRCLE.sample(COARSE).pose + offset, [0.5, 0.01, 0.5], COARSE).metrics
    actual = run_along(moved_circle, moved_circle.sample(COARSE).pose + moved_offset, [0.5, 0.01, 0.5], COARSE).metrics
    for name in ("position_rmse_m", "position_std_m", "heading_max_rad", "course_rmse_rad", "lateral_rmse_m"):
        assert getattr(actual, name) == pytest.approx(getattr(original, name), rel=1e-6), name


LINE = ConstantTwist(v=0.5, omega=0.0, duration=1.0)
SECOND = np.arange(0, 51) * 0.02


def test_ticks_after_the_end_of_the_reference_are_not_counted() -> None:
    run, short = (simulate(FeedForward({100: "BRAKING"}), KinematicPlant(), LINE, extra_time=extra) for extra in (1, 0))
    end = np.where(np.arange(101) < 51, 0.0, 9.0)
    worse = replace(run, true_pose=run.true_pose + end[:, None], solver_iterations=end).with_step_time(end, end)
    short = replace(short, solver_iterations=end[:51]).with_step_time(end[:51], end[:51])
    assert (len(run.time), short.metrics.steps, short.metrics.completed) == (101, 51, True)
    # Stops count up to the end of the run.
    assert asdict(worse.metrics) == pytest.approx(asdict(short.metrics) | {"stopped": True})


def test_statistics_of_unequal_errors_match_their_definitions() -> None:
    """The errors are squares of 0 to 20, in 0.1 mm to the left and right, and in 0.1 mrad."""
    signed = 1e-4 * np.arange(21.0) ** 2 * (-1) ** np.arange(21)
    pose = LINE.sample(SECOND[:21]).pose + np.outer(signed, [0, 1, 1])
    metrics = run_along(LINE, pose, [0.5, 0.0, 0.0], SECOND[:21]).metrics
    mean, rms = 1e-4 * 20 * 41 / 6, 1e-4 * np.sqrt(20 * 41 * 1259 / 30)  # sums of squares and of fourth powers over 21
    for name, unit in (("position", "m"), ("heading", "rad")):
        values = [getattr(metrics, f"{name}_{statistic}_{unit}") for statistic in ("rmse", "mean", "std", "max")]
        assert values == pytest.approx([rms, mean, np.sqrt(rms**2 - mean**2), 0.04])
    lateral = metrics.lateral_rmse_m, metrics.lateral_mae_m, metrics.lateral_p95_m, metrics.lateral_max_m
    assert lateral == pytest.approx((rms, mean, 0.0361, 0.04))


def test_fallback_ticks_are_counted_by_mode() -> None:
    modes = {3: "REUSED_PLAN", 4: "BRAKING", 5: "STOPPED", 50: "FINISHED"}
    run = simulate(FeedForward(modes), KinematicPlant(), LINE)
    assert run.metrics.fallbacks == 3
    assert run.metrics.completed and run.metrics.stopped
    assert not simulate(FeedForward({0: "STOPPED"}), KinematicPlant(), LINE).metrics.stopped, "the start is late"


def test_every_mode_of_the_controller_is_classified() -> None:
    assert FALLBACK_MODES | {"TRACKING", "FINISHED"} == {mode.value for mode in Mode}
    assert not FALLBACK_MODES & {"TRACKING", "FINISHED"}
    assert BRAKING_MODES < FALLBACK_MODES


def test_run_is_completed_if_it_ends_in_tracking_at_the_end_of_the_reference() -> None:
    for mode in ("BRAKING", "STOPPED"):
        assert not simulate(FeedForward({50: mode}), KinematicPlant(), LINE).metrics.completed
    pose = LINE.sample(SECOND).pose
    near, far, short = (
        run_along(LINE, (pose + [ahead, 0.0, 0.0])[:count], [0.5, 0.0, 0.0], SECOND[:count])
        for ahead, count in ((0.2, 51), (0.3, 51), (0.0, 40))
    )
    at_rest = run_along(LINE, np.tile(pose[-1], (51, 1)), [0.0, 0.0, 0.0], SECOND)  # as on a closed path
    assert near.metrics.completed and not at_rest.metrics.completed
    assert not replace(near, ended="the robot is lost").metrics.completed
    assert not far.metrics.completed and not short.metrics.completed


def test_non_finite_pose_makes_the_error_nan() -> None:
    pose = LINE.sample(SECOND).pose
    pose[20] = np.nan
    metrics = run_along(LINE, pose, [0.5, 0.0, 0.0], SECOND).metrics
    assert not metrics.completed
    assert np.isnan(metrics.position_rmse_m)
    assert metrics.in_band_percent == pytest.approx(100 * 50 / 51)


def test_step_longer_than_the_sample_is_a_missed_deadline() -> None:
    assert simulate(FeedForward(), KinematicPlant(), LINE).metrics.deadline_misses == 0
    slow = simulate(SlowController(), KinematicPlant(), LINE).metrics
    assert slow.deadline_misses == slow.steps == 51
    assert slow.step_time_p99_s == pytest.approx(0.03)


def test_step_times_can_be_replaced_by_those_of_a_timing_pass() -> None:
    run = simulate(SlowController(), KinematicPlant(), LINE)
    times = np.linspace(0.0, 0.01, 51)
    retimed = run.with_step_time(times)
    assert retimed.metrics.step_time_max_s == 0.01
    assert retimed.metrics.step_time_p50_s == pytest.approx(0.005)
    assert retimed.metrics.step_time_p95_s == pytest.approx(0.0095)
    assert retimed.metrics.step_time_p99_s == pytest.approx(0.0099)
    assert retimed.metrics.position_rmse_m == run.metrics.position_rmse_m
    with_gaps = run.with_step_time(np.where(times < 0.006, times, np.nan), 0.5 * times).metrics
    assert with_gaps.step_time_max_s == pytest.approx(0.0058)
    assert with_gaps.step_time_p50_s == pytest.approx(0.0029)
    assert (with_gaps.solve_time_p50_s, with_gaps.deadline_misses) == (pytest.approx(0.0025), 0)
    with pytest.raises(ValueError, match="51 ticks"):
        run.with_step_time(times[1:])


WINDOW = 0.6


def sequential_distances(path, points, arc_length):
    """Compute the unsigned distances (n,) [m] one point after the other, as documented in `Polyline.lateral`."""
    distances, piece = [], None
    for i, point in enumerate(points):
        near = (path.arc_end >= arc_length[i] - WINDOW) & (path.arc_start <= arc_length[i] + WINDOW)
        if piece is not None:
            # Also search around the previous nearest piece, widened by twice the distance between the points.
            reach = min(WINDOW, 2.0 * np.hypot(*(point - points[i - 1])))
            nearby = (path.arc_end >= path.arc_start[piece] - reach) & (path.arc_start <= path.arc_end[piece] + reach)
            searched = np.flatnonzero(near | nearby)
            near[searched[0] : searched[-1] + 1] = True
        offset = point - path.start
        along = np.clip((offset * path.direction).sum(axis=1), 0.0, path.length)
        gaps = np.where(near, np.hypot(*(offset - along[:, None] * path.direction).T), np.inf)
        piece = int(gaps.argmin())
        distances.append(gaps[piece])
    return distances


def test_projection_of_all_points_equals_sequential_projection():
    """Use points on, next to and far behind a random path; each search depends on the previous result."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        corners = np.cumsum(rng.normal(0.0, 0.3, (40, 2)) + [0.1, 0.0], axis=0)
        steps = np.diff(corners, axis=0)
        length = np.hypot(*steps.T)
        arc = np.concatenate([[0.0], np.cumsum(length)])
        path = Polyline(corners[:-1], steps / length[:, None], length, arc[:-1], arc[1:])
        # The robot falls behind its expected position by a random fraction, and is sometimes displaced.
        expected = np.linspace(0.0, 0.9 * arc[-1], rng.integers(2, 80))
        positions = expected * rng.uniform(0.3, 1.0)
        points = np.column_stack([np.interp(positions, arc, corners[:, i]) for i in (0, 1)])
        points = points + rng.choice([0.0, 0.02, 0.5]) * rng.normal(size=points.shape)
        distances = sequential_distances(path, points, expected)
        assert np.allclose(np.abs(path.lateral(points, expected, WINDOW)), distances, rtol=0.0, atol=1e-9)


TICK = 0.0202
SETTLED_ARC = metric_settings().settled_arc
S, BACKWARD = load_trajectory("s"), ConstantTwist(-0.5, 0.5, 6.0)


def run_with_offset(reference, lateral):
    """Build a run that drives `lateral` (n,) to the left of the reference."""
    times = np.arange(0.0, reference.duration, TICK)
    pose = shift_left(reference.sample(times).pose, np.broadcast_to(lateral, times.shape)[:, None])
    return run_along(reference, pose, [0.5, 0.0, 0.5], times)


def test_each_arc_has_its_own_bias_without_its_settling_time():
    """The error is 0.1 m outside the settled parts of the three arcs."""
    lateral = np.full(len(run_with_offset(S, 0.0).time), 0.1)
    arcs = steady_arcs(run_with_offset(S, 0.0))
    for ticks, error in zip(arcs, (-0.010, 0.006, 0.03), strict=True):
        lateral[ticks] = error
    assert steady_arc_lateral(run_with_offset(S, lateral)) == pytest.approx([-0.010, 0.006, 0.03], abs=1e-5)


@pytest.mark.parametrize("side", [0.03, -0.02])
@pytest.mark.parametrize(
    ("reference", "arcs"),
    [
        *((load_trajectory(name), arcs) for name, arcs in {"circle": 1, "square": 0, "s": 3, "cane": 1}.items()),
        *((ConstantTwist(*twist, 6.0), 0) for twist in ((0.5, 0.0), (0.0, 1.0))),
        *((ConstantTwist(0.5, 0.5, SETTLED_ARC + more), arcs) for more, arcs in ((-TICK, 0), (2 * TICK, 1))),
        (BACKWARD, 1),
    ],
)
def test_constant_distance_is_the_bias_of_each_settled_arc(reference, arcs, side):
    """The left side of a robot that drives backwards is the right side of the path."""
    run = run_with_offset(reference, side)
    bias = -side if reference is BACKWARD else side
    assert steady_arc_lateral(run) == pytest.approx([bias] * arcs, abs=1e-5)
    for ticks in steady_arcs(run):
        assert np.ptp(run.reference_twist[ticks], axis=0) == pytest.approx(0.0, abs=1e-5)
        assert (np.diff(ticks) == 1).all()
