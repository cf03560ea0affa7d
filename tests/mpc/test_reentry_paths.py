"""Ways back: from the robot's pose and course into the reference, inside the limits, wherever the robot is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.mpc.reentry.options import Course
from diffdrive_mpc.mpc.reentry.path_window import MotionLine, PathWindow, path_speeds, travel_times, turning_times
from diffdrive_mpc.mpc.reentry.quintic_path import quintic_paths
from diffdrive_mpc.mpc.reentry.way_back import rejoin
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments

LIMITS = TrajectoryLimits(v=0.625, omega=1.5, v_acceleration=1.0, omega_acceleration=2.0)
ROBOT = TrajectoryLimits.of_robot()
REFERENCES = {name: load_trajectory(name) for name in ("circle", "square", "s", "cane")}
REFERENCES["backwards"] = lay_segments([Segment(v=-0.4, omega=0.3, duration=8.0)], ROBOT, name="backwards")
REFERENCES["to and fro"] = lay_segments(
    [Segment(v=0.4, omega=0.0, duration=4.0), Segment(v=-0.4, omega=0.2, duration=4.0)], ROBOT, name="to and fro"
)
REFERENCES["turning"] = lay_segments([Segment(v=0.0, omega=0.8, duration=9.0)], ROBOT, name="turning")

angles, bends = st.floats(-np.pi, np.pi), st.floats(-2.0, 2.0)
ends = st.tuples(st.floats(0.3, 2.0), st.floats(-1.0, 1.0), angles)


@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), angles), bends, ends, bends)
def test_a_path_meets_pose_and_curvature_at_both_ends(start, start_bend, shift, end_bend):
    start, end = np.array(start), np.array(start) + shift
    nodes = 4001
    path = quintic_paths(start[None], np.array([start_bend]), end[None], np.array([end_bend]), nodes)
    for at, pose, bend in ((0, start, start_bend), (-1, end, end_bend)):
        assert path.points[0, at] == pytest.approx(pose[:2], abs=1e-9)
        assert wrap_angle(path.heading[0, at] - pose[2]) == pytest.approx(0.0, abs=1e-6)
        assert path.curvature[0, at] == pytest.approx(bend, abs=1e-6)


@given(st.floats(-1.5, 1.5), bends, bends)
def test_heading_curvature_and_length_belong_to_the_points(angle, start_bend, end_bend):
    end = np.array([1.0, 0.4, angle])
    path = quintic_paths(np.zeros((1, 3)), np.array([start_bend]), end[None], np.array([end_bend]), 4001)
    step = np.diff(path.points[0], axis=0)
    chord = np.hypot(*step.T)
    middle = 0.5 * (path.heading[0, 1:] + path.heading[0, :-1])
    assert np.abs(wrap_angle(np.arctan2(step[:, 1], step[:, 0]) - middle)).max() < 1e-3
    assert np.abs(path.lengths[0] / chord - 1.0).max() < 1e-3
    turned = np.concatenate(
        [[0.0], np.cumsum(0.5 * (path.curvature[0, 1:] + path.curvature[0, :-1]) * path.lengths[0])]
    )
    assert np.abs(path.heading[0] - path.heading[0, 0] - turned).max() < 1e-3


@given(ends, bends, st.floats(0.0, 0.6), st.floats(0.0, 0.6))
def test_speeds_keep_to_every_limit_on_every_piece(end, bend, enter, leave):
    path = quintic_paths(np.zeros((1, 3)), np.array([bend]), np.array([end]), np.zeros(1), 33)
    speed = path_speeds(path, np.array([enter]), np.array([leave]), LIMITS, np.ones(1))[0, 0]
    k, ds = path.curvature[0], path.lengths[0]
    slack = 1 + 1e-6
    assert speed[0] <= enter
    assert speed[-1] <= leave
    assert speed.max() <= LIMITS.v * slack
    assert np.abs(speed * k).max() <= LIMITS.omega * slack
    acceleration = np.diff(speed**2) / (2 * ds)
    assert np.abs(acceleration).max() <= LIMITS.v_acceleration * slack
    # d(k v)/dt = dk/ds v^2 + k a at both ends of each piece.
    change = np.diff(k) / ds
    for at in (slice(None, -1), slice(1, None)):
        yaw = np.abs(change) * speed[at] ** 2 + np.abs(k[at] * acceleration)
        assert yaw.max() <= LIMITS.omega_acceleration * slack
    assert travel_times(path, speed[None])[0, -1] >= ds.sum() / LIMITS.v * (1 - 1e-6)


def test_a_straight_from_rest_to_rest_is_driven_as_fast_as_possible():
    path = quintic_paths(np.zeros((1, 3)), np.zeros(1), np.array([[1.0, 0.0, 0.0]]), np.zeros(1), 401)
    speed = path_speeds(path, np.zeros(1), np.zeros(1), LIMITS, np.ones(1))[0]
    # A trapezoid: v / a to reach the speed, and as long to leave it, with v^2 / a of way; the rest at v.
    expected = LIMITS.v / 1.0 + 1.0 / LIMITS.v
    assert travel_times(path, speed)[0, -1] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("angle", [0.2, -1.0, 3.0])
def test_a_turn_on_the_spot_keeps_to_the_limits_and_takes_the_time_said(angle):
    line = MotionLine(np.array([1.0, 2.0, 0.5]))
    line.turn(angle, LIMITS)
    turn = line.trajectory("turn", 0.5 + angle)
    times = np.linspace(0.0, turn.duration, 2001)
    sample = turn.sample(times)
    assert turn.duration == pytest.approx(float(turning_times(np.array([angle]), LIMITS)[0]))
    assert sample.pose[-1] == pytest.approx([1.0, 2.0, 0.5 + angle])
    assert np.abs(sample.twist[:, 1]).max() <= LIMITS.omega + 1e-9
    assert np.abs(np.diff(sample.twist[:, 1]) / np.diff(times)).max() <= LIMITS.omega_acceleration + 1e-6
    assert sample.pose[:, :2] == pytest.approx(np.tile([1.0, 2.0], (2001, 1)))


def test_braking_follows_the_arc_of_the_motion():
    line = MotionLine(np.zeros(3))
    line.brake(0.5, 0.5, 0.5)
    stop = line.trajectory("stop", 0.0)
    end = stop.sample([0.5]).pose[0]
    # Mean speed half of the first: 0.125 m on a circle of 1 m.
    assert end == pytest.approx([np.sin(0.125), 1 - np.cos(0.125), 0.125], abs=1e-5)


def connect(name, time, across, turned, v=0.0, omega=0.0):
    """A robot `across` [m] from the reference at `time` [s] and `turned` [rad] from it; its way back."""
    reference = REFERENCES[name]
    pose = reference.sample([time]).pose[0]
    pose[:2] += across * np.array([-np.sin(pose[2]), np.cos(pose[2])])
    pose[2] += turned
    window = PathWindow.around(reference, time, 6.0, 0.05)
    here = window.nearest(pose, time)
    return pose, rejoin(reference, window, here, Course(pose, v, omega), time, (0.2, 2.0), LIMITS), window.times[here]


anywhere = st.tuples(
    st.sampled_from(list(REFERENCES)),
    st.floats(0.0, 9.0),
    st.floats(-0.9, 0.9),
    angles,
    st.floats(-0.5, 0.6),
    st.floats(-1.5, 1.5),
)


@settings(max_examples=150)
@given(anywhere)
def test_from_anywhere_it_leads_from_the_robot_into_the_reference(where):
    pose, way, nearest = connect(*where)
    reference = way.reference
    # From the robot ...
    first = way.sample([way.begins])
    assert first.pose[0, :2] == pytest.approx(pose[:2], abs=1e-9)
    assert wrap_angle(first.pose[0, 2] - pose[2]) == pytest.approx(0.0, abs=1e-6)
    # ... without a jump ...
    times = np.arange(way.begins, way.joins + 0.3, 0.002)
    sample = way.sample(times)
    assert np.isfinite(sample.pose).all()
    assert np.hypot(*np.diff(sample.pose[:, :2], axis=0).T).max() < 0.0101 + 0.002
    assert np.abs(np.diff(sample.pose[:, 2])).max() < 0.01
    assert (np.diff(sample.arc_length) >= -1e-9).all()
    # ... ahead of where it is, to the reference.
    assert way.joins >= nearest
    at_join = reference.sample([way.joins])
    assert way.sample([way.joins]).pose == pytest.approx(at_join.pose)
    last = way.connection.sample([way.connection.duration]).pose[0]
    assert np.hypot(*(last - at_join.pose[0])[:2]) <= 0.0101  # to a point this near it only turns
    assert last[2] == pytest.approx(at_join.pose[0, 2], abs=1e-6)
    # Spline pieces may exceed what holds at their ends by a little.
    assert np.abs(sample.twist[times < way.joins, 0]).max() <= LIMITS.v * 1.02
    assert np.abs(sample.twist[times < way.joins, 1]).max() <= LIMITS.omega * 1.05
    assert 0 < way.connection.duration < 12.0


# Where the reference drives at its cruise for as far as a way back may reach.
@settings(max_examples=60)
@given(
    st.sampled_from([("circle", 4.0), ("circle", 7.5), ("s", 5.5), ("backwards", 2.0)]),
    st.floats(-0.3, 0.3),
    st.floats(-0.4, 0.4),
)
def test_beside_a_moving_reference_it_keeps_course_and_joins_with_twist(where, across, turned):
    name, time = where
    twist = REFERENCES[name].sample([time]).twist[0]
    _, way, _ = connect(name, time, across, turned, *twist)
    # The way back begins with the robot's speed, or so much slower as its first bend is too tight for it, and ends with
    # the reference's, with its curvature; a difference of 0.16 m/s is 0.08 s of command slew.
    start, end = way.connection.sample([0.0]), way.connection.sample([way.connection.duration])
    assert start.twist[0, 0] == pytest.approx(twist[0], abs=0.16)
    assert end.twist[0] == pytest.approx(REFERENCES[name].sample([way.joins]).twist[0], abs=0.1)
    # Smooth: forwards all the way, without a stop.
    times = np.linspace(0.0, way.connection.duration, 400)
    speeds = np.sign(twist[0]) * way.connection.sample(times).twist[:, 0]
    assert speeds.min() > 0.1


def test_facing_backwards_it_turns_on_the_spot_before_it_drives():
    _, way, _ = connect("circle", 4.0, 0.3, np.pi)
    times = np.linspace(0.0, way.connection.duration, 1000)
    sample = way.connection.sample(times)
    moving = np.abs(sample.twist[:, 0]) > 0.05
    assert np.abs(wrap_angle(sample.pose[:, 2] - sample.pose[0, 2]))[moving].min() > 1.0
    assert (sample.twist[:, 0] > -1e-9).all()


def test_the_smallest_displacement_costs_the_smallest_delay():
    """Beside a reference that it could follow, the robot need not fall behind much."""
    for across in (-0.2, 0.2):
        twist = REFERENCES["circle"].sample([4.0]).twist[0]
        _, way, _ = connect("circle", 4.0, across, 0.0, *twist)
        assert abs(4.0 - way.begins) < 0.25
