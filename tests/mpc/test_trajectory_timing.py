"""Timing of trajectories by limits, scaling, and checks of their speeds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from trajectory_checks import assert_holds_its_ends, largest_integration_gap, largest_shares

from diffdrive_mpc import (
    Trajectory,
    VelocityModel,
    integrate_pose,
    load_config,
    load_trajectory,
)
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.mpc.problem.build import chosen_model
from diffdrive_mpc.mpc.trajectories import BUILT_IN, TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.limits import load_settings
from diffdrive_mpc.mpc.trajectories.moved import scaled_to_robot
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_commands, time_segments
from diffdrive_mpc.mpc.trajectories.smooth_segments import time_smooth_path
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory
from diffdrive_mpc.mpc.trajectories.waypoints import MAX_DEVIATION, time_waypoints

LIMITS = TrajectoryLimits.of_robot()
PATHS_IN_FILES = [name for name in BUILT_IN if name not in {"circle", "square", "s", "cane"}]


def segment(v: float, omega: float, duration: float) -> Segment:
    return Segment(v=v, omega=omega, duration=duration)


@st.composite
def segment_lists(draw: st.DrawFn) -> list[Segment]:
    """Draw one to six segments: arcs forwards and backwards, straights, turns on the spot, waits."""
    speeds = st.sampled_from([-0.8, -0.3, 0.0, 0.4, 0.9, 1.3])
    turns = st.sampled_from([-1.4, -0.5, 0.0, 0.3, 1.0])
    pieces = st.tuples(speeds, turns, st.floats(0.3, 4.0))
    return [segment(*piece) for piece in draw(st.lists(pieces, min_size=1, max_size=6))]


def sample_times(trajectory: Trajectory, count: int = 4001) -> FloatArray:
    return np.linspace(0.0, trajectory.duration, count)


def drawn_path(segments: list[Segment]) -> FloatArray:
    """Return points (n, 2) x, y [m] along the segments, a millimetre apart."""
    pose, points = np.zeros(3), [np.zeros((1, 2))]
    for segment in segments:
        share = np.linspace(0.0, segment.duration, 2 + int(abs(segment.v) * segment.duration / 1e-3))
        poses = integrate_pose(pose, segment.v * share, segment.omega * share, 1.0)
        points.append(poses[:, :2])
        pose = poses[-1]
    return np.concatenate(points)


# --- Commanded timing.


@settings(max_examples=40, deadline=None)
@given(segment_lists())
def test_commanded_twists_equal_the_segments(segments: list[Segment]) -> None:
    # The straight segments before and after contain the ramps.
    straights = [segment(0.5, 0.0, 1.0)]
    trajectory = time_commands([*straights, *segments, *straights], LIMITS, name="test")
    start = trajectory.duration - 1.25 - sum(piece.duration for piece in segments)
    assert start == pytest.approx(1.25)
    for piece in segments:
        times = start + piece.duration * np.array([1e-6, 0.3, 0.5, 1 - 1e-6])
        np.testing.assert_allclose(trajectory.sample(times).twist, [(piece.v, piece.omega)] * 4, rtol=0, atol=1e-12)
        start += piece.duration


@settings(max_examples=40, deadline=None)
@given(segment_lists())
def test_pose_integrates_commanded_twists_along_the_drawn_path(segments: list[Segment]) -> None:
    trajectory = time_commands(segments, LIMITS, name="test")
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=20) < 1e-9
    end = np.zeros(3)
    for segment in segments:
        end = integrate_pose(end, segment.v, segment.omega, segment.duration)
    np.testing.assert_allclose(trajectory.sample([trajectory.duration]).pose[0], end, rtol=0, atol=1e-12)
    assert_holds_its_ends(trajectory)
    stopping = time_segments(segments, LIMITS, name="test")
    assert trajectory.duration <= stopping.duration + 1e-9


def test_reference_beyond_the_reachable_speed_of_the_model_raises_error() -> None:
    """A robot with a yaw gain of 0.7 reaches 0.7 of the limit; the start reports the excess."""
    config = load_config("ssm", {"limits.omega": 1.0})
    turning = time_segments([segment(0.5, 1.0, 3.0)], LIMITS, name="arc")
    max_omega = float(np.abs(turning.sample(np.linspace(0, turning.duration, 400)).twist[:, 1]).max())
    check_speeds(turning, config.limits, config.sample_time, np.diag([1.0, max_omega]))
    with pytest.raises(ValueError, match=r"'arc': omega = .* takes a command of 1\.43 .* limits\.omega = 1"):
        check_speeds(turning, config.limits, config.sample_time, np.diag([1.0, 0.7 * max_omega]))


def test_every_shipped_reference_is_within_reach_of_every_shipped_model() -> None:
    for name in ("mbm", "sm", "ssm", "kinematic"):
        config = load_config(name)
        gain = chosen_model(config, None).dc_gain
        for path in BUILT_IN:
            check_speeds(load_trajectory(path), config.limits, config.sample_time, gain)


def test_steps_of_the_twist_are_accepted() -> None:
    config = load_config("ssm")
    stepping = time_commands([segment(0.5, 1.0, 2.0), segment(0.5, -1.0, 2.0)], LIMITS, name="two arcs")
    check_speeds(stepping, config.limits, config.sample_time)


# --- Smooth timing.


@settings(max_examples=40, deadline=None)
@given(segment_lists())
def test_smooth_path_stays_within_its_reported_distance(segments: list[Segment]) -> None:
    trajectory = time_smooth_path(segments, LIMITS, name="test", smoothing=0.02)
    times = sample_times(trajectory, 1500)
    points = trajectory.sample(times).pose[:, :2]
    nearest, _ = cKDTree(drawn_path(segments)).query(points)
    reported = trajectory.drawn_distance(times)
    assert reported.max() <= 0.02
    # Another part of the path may be nearer than reported; the tolerance is the sampling of the drawn path.
    assert np.all(nearest <= reported + 6e-4)
    end = time_segments(segments, LIMITS, name="test")
    np.testing.assert_allclose(
        trajectory.sample([trajectory.duration]).pose, end.sample([end.duration]).pose, rtol=0, atol=1e-7
    )


@settings(max_examples=40, deadline=None)
@given(segment_lists())
def test_smooth_trajectory_satisfies_every_limit(segments: list[Segment]) -> None:
    trajectory = time_smooth_path(segments, LIMITS, name="test")
    assert np.all(largest_shares(trajectory, LIMITS) <= 1.002)
    v, omega = trajectory.sample(sample_times(trajectory)).twist.T
    assert np.abs(v * omega).max() <= LIMITS.lateral_acceleration * 1.002
    assert np.abs(v).max() <= max(abs(segment.v) for segment in segments) * 1.001 + 1e-9
    assert_holds_its_ends(trajectory)


@settings(max_examples=40, deadline=None)
@given(segment_lists())
def test_smooth_pose_twist_and_arc_length_agree(segments: list[Segment]) -> None:
    trajectory = time_smooth_path(segments, LIMITS, name="test")
    assert largest_integration_gap(trajectory, trajectory.breaks, pieces=1) < 2e-5


def test_smooth_path_has_continuous_curvature_and_uses_its_tolerance() -> None:
    distances, durations = [], []
    for smoothing in (0.005, 0.01, 0.02):
        arcs = [segment(1.0, 0.5, 3.0), segment(1.0, -0.5, 6.0), segment(1.0, 0.5, 3.0)]
        trajectory = time_smooth_path(arcs, LIMITS, name="test", smoothing=smoothing)
        middle = np.linspace(1.5, trajectory.duration - 1.5, 6001)
        sample = trajectory.sample(middle)
        curvature = sample.twist[:, 1] / sample.twist[:, 0]
        # The curvature changes gradually along the path, not from one sample to the next.
        assert np.abs(np.diff(curvature) / np.diff(sample.arc_length)).max() < 6.0
        assert curvature.min() < -0.5 < 0.5 < curvature.max()
        distances.append(trajectory.drawn_distance(sample_times(trajectory)).max())
        durations.append(trajectory.duration)
    np.testing.assert_allclose(distances, [0.005, 0.01, 0.02], rtol=0.01)
    assert durations == sorted(durations, reverse=True)
    assert durations[0] < time_segments(arcs, LIMITS, name="test").duration


def test_smooth_timing_stops_only_at_cusps_and_turns_on_the_spot() -> None:
    arcs = [segment(0.5, 0.3, 2.0), segment(0.5, -0.3, 2.0), segment(-0.5, 0.3, 2.0), segment(0.0, 1.0, 1.0)]
    trajectory = time_smooth_path([*arcs, *arcs], LIMITS, name="test")
    v = trajectory.sample(sample_times(trajectory, 40001)).twist[1:-1, 0]
    standing = np.abs(v) < 1e-3
    stops = np.count_nonzero(np.diff(standing.astype(int)) == 1)
    # Stops inside the path: cusp, turn, cusp, and the turn at the end.
    assert stops == 4
    square = load_trajectory("square", timing="smooth")
    sample = square.sample(sample_times(square))
    turning = np.abs(sample.twist[:, 1]) > 1e-9
    assert np.abs(sample.twist[turning, 0]).max() < 1e-9
    assert square.drawn_distance(sample_times(square)).max() == 0.0


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.floats(0.6, 1.5), st.floats(-1.2, 1.2)), min_size=1, max_size=5))
def test_waypoints_with_smooth_timing_limit_the_lateral_acceleration(legs: list[tuple[float, float]]) -> None:
    heading = np.cumsum([turn for _, turn in legs])
    steps = np.array([length for length, _ in legs])[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    points = [(0.0, 0.0), *((float(x), float(y)) for x, y in np.cumsum(steps, axis=0))]
    trajectory = time_waypoints(points, LIMITS, name="test", timing="smooth")
    v, omega = trajectory.sample(sample_times(trajectory)).twist.T
    assert np.abs(v * omega).max() <= LIMITS.lateral_acceleration * 1.001
    assert np.all(largest_shares(trajectory, LIMITS) <= 1.001)
    assert trajectory.drawn_distance(sample_times(trajectory)).max() <= MAX_DEVIATION


# --- Timing in files.


@pytest.mark.parametrize("name", [*PATHS_IN_FILES, "spline-0", "spline-7"])
def test_shipped_paths_satisfy_the_limits_of_shipped_configurations(name: str) -> None:
    trajectory = load_trajectory(name)
    assert trajectory.name == name
    for model in ("mbm", "sm", "ssm"):
        config = load_config(model)
        check_speeds(trajectory, config.limits, config.sample_time)
    shares = largest_shares(trajectory, LIMITS)
    assert np.all(shares[: 2 if name == "tight" else 4] <= 1.002)


@pytest.mark.parametrize("seed", [0, 1, 12, 2**70])
def test_random_paths_are_reproducible_and_distinct(seed: int) -> None:
    first, repeated, second = (load_trajectory(f"spline-{n}") for n in (seed, seed, seed + 1))
    assert isinstance(first, SplineTrajectory) and isinstance(repeated, SplineTrajectory)
    assert first.table.tobytes() == repeated.table.tobytes()
    assert first.duration != second.duration
    twist = np.abs(first.sample(sample_times(first)).twist)
    assert twist[:, 0].max() > 1.1
    assert twist[:, 1].max() > 1.0


PATHS = ("circle", "square", "s", "cane", "figure8", "k_turn")
size = st.floats(0.1, 10.0)
SCALED_KEYS = [f"limits.{name}" for name in ("v", "omega", "wheel_speed", "v_slew", "omega_slew")]
SCALED_KEYS += ["wheels.track", "wheels.encoder_track"]


@settings(max_examples=40, deadline=None)
@given(
    path=st.sampled_from(PATHS),
    values=st.fixed_dictionaries(dict.fromkeys(SCALED_KEYS, size)),
    gains=st.tuples(st.floats(0.3, 2.0), st.floats(0.3, 2.0)),
    lag=st.floats(0.01, 3.0),
)
def test_scaled_path_satisfies_limits_and_keeps_its_shape_for_any_robot(path, values, gains, lag):
    config, shares = load_config("sm", values), load_settings()
    rate = np.eye(2) / lag
    model = VelocityModel("lag", "sm", -rate, rate * gains, np.eye(2))
    scaled, original = scaled_to_robot(path, config, model), load_trajectory(path, timing="stop")
    assert scaled.name == f"{original.name} scaled to the robot" and "times the lengths of the file" in scaled.remark
    dt = scaled.duration / 4000
    twist = scaled.sample(np.arange(4001) * dt).twist
    command = np.abs(twist) / gains
    limits = config.limits
    assert command[:, 0].max() <= shares.reach_share * limits.v * (1 + 1e-9)
    assert command[:, 1].max() <= shares.reach_share * limits.omega * (1 + 1e-9)
    wheel_speed = command[:, 0] + 0.5 * config.wheels.track * command[:, 1]
    assert wheel_speed.max() <= shares.reach_share * limits.wheel_speed * (1 + 1e-9)
    slew = np.abs(np.diff(command, axis=0)).max(axis=0) / dt
    assert slew[0] <= shares.slew_share * limits.v_slew * (1 + 1e-6)
    assert slew[1] <= shares.slew_share * limits.omega_slew * (1 + 1e-6)

    # The command that a robot with this lag needs, from the inverse of its model.
    required = command[:-1] + lag * np.abs(np.diff(command, axis=0)) / dt
    assert required[:, 0].max() <= limits.v
    assert required[:, 1].max() <= limits.omega

    scale = config.wheels.encoder_track / load_robot().track
    end, shipped = (reference.sample(np.array([reference.duration])) for reference in (scaled, original))
    np.testing.assert_allclose(end.pose[0, :2], scale * shipped.pose[0, :2], atol=1e-6 * scale)
    np.testing.assert_allclose(end.pose[0, 2], shipped.pose[0, 2], atol=1e-6)
    np.testing.assert_allclose(end.arc_length, scale * shipped.arc_length, rtol=1e-6)
