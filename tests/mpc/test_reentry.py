"""Re-entry: return paths to the reference, and the closed loop on them."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ideal_robot import PROMPT, IdealRobot

from diffdrive_mpc import Controller, load_config, load_model, load_trajectory
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.reentry.options import RobotState
from diffdrive_mpc.mpc.reentry.path_window import MotionLine, PathWindow, path_speeds, travel_times, turning_times
from diffdrive_mpc.mpc.reentry.quintic_path import quintic_paths
from diffdrive_mpc.mpc.reentry.rejoin import rejoin
from diffdrive_mpc.mpc.trajectories import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments

LIMITS = TrajectoryLimits(v=0.625, omega=1.5, v_acceleration=1.0, omega_acceleration=2.0)
ROBOT = TrajectoryLimits.of_robot()
REFERENCES = {name: load_trajectory(name) for name in ("circle", "square", "s", "cane")}
REFERENCES["backwards"] = time_segments([Segment(v=-0.4, omega=0.3, duration=8.0)], ROBOT, name="backwards")
REFERENCES["back and forth"] = time_segments(
    [Segment(v=0.4, omega=0.0, duration=4.0), Segment(v=-0.4, omega=0.2, duration=4.0)], ROBOT, name="back and forth"
)
REFERENCES["turning"] = time_segments([Segment(v=0.0, omega=0.8, duration=9.0)], ROBOT, name="turning")

angles, curvatures = st.floats(-np.pi, np.pi), st.floats(-2.0, 2.0)
ends = st.tuples(st.floats(0.3, 2.0), st.floats(-1.0, 1.0), angles)


@given(st.tuples(st.floats(-1, 1), st.floats(-1, 1), angles), curvatures, ends, curvatures)
def test_quintic_path_meets_pose_and_curvature_at_both_ends(start, start_bend, shift, end_bend):
    start, end = np.array(start), np.array(start) + shift
    nodes = 4001
    path = quintic_paths(start[None], np.array([start_bend]), end[None], np.array([end_bend]), nodes)
    for index, pose, curvature in ((0, start, start_bend), (-1, end, end_bend)):
        assert path.points[0, index] == pytest.approx(pose[:2], abs=1e-9)
        assert wrap_angle(path.heading[0, index] - pose[2]) == pytest.approx(0.0, abs=1e-6)
        assert path.curvature[0, index] == pytest.approx(curvature, abs=1e-6)


@given(st.floats(-1.5, 1.5), curvatures, curvatures)
def test_heading_curvature_and_length_match_the_points(angle, start_bend, end_bend):
    end = np.array([1.0, 0.4, angle])
    path = quintic_paths(np.zeros((1, 3)), np.array([start_bend]), end[None], np.array([end_bend]), 4001)
    step = np.diff(path.points[0], axis=0)
    chord = np.hypot(*step.T)
    middle = 0.5 * (path.heading[0, 1:] + path.heading[0, :-1])
    assert np.abs(wrap_angle(np.arctan2(step[:, 1], step[:, 0]) - middle)).max() < 1e-3
    assert np.abs(path.lengths[0] / chord - 1.0).max() < 1e-3
    turn = np.concatenate([[0.0], np.cumsum(0.5 * (path.curvature[0, 1:] + path.curvature[0, :-1]) * path.lengths[0])])
    assert np.abs(path.heading[0] - path.heading[0, 0] - turn).max() < 1e-3


@given(ends, curvatures, st.floats(0.0, 0.6), st.floats(0.0, 0.6))
def test_speeds_satisfy_every_limit_on_every_piece(end, bend, start_speed, end_speed):
    path = quintic_paths(np.zeros((1, 3)), np.array([bend]), np.array([end]), np.zeros(1), 33)
    speed = path_speeds(path, np.array([start_speed]), np.array([end_speed]), LIMITS, np.ones(1), np.ones(1))[0, 0]
    k, ds = path.curvature[0], path.lengths[0]
    tolerance = 1 + 1e-6
    assert speed[0] <= start_speed
    assert speed[-1] <= end_speed
    assert speed.max() <= LIMITS.v * tolerance
    assert np.abs(speed * k).max() <= LIMITS.omega * tolerance
    acceleration = np.diff(speed**2) / (2 * ds)
    assert np.abs(acceleration).max() <= LIMITS.v_acceleration * tolerance
    # d(k v)/dt = dk/ds v^2 + k a at both ends of each piece.
    change = np.diff(k) / ds
    for piece_ends in (slice(None, -1), slice(1, None)):
        yaw_acceleration = np.abs(change) * speed[piece_ends] ** 2 + np.abs(k[piece_ends] * acceleration)
        assert yaw_acceleration.max() <= LIMITS.omega_acceleration * tolerance
    assert travel_times(path, speed[None])[0, -1] >= ds.sum() / LIMITS.v * (1 - 1e-6)


def test_straight_line_from_rest_to_rest_takes_the_shortest_time():
    path = quintic_paths(np.zeros((1, 3)), np.zeros(1), np.array([[1.0, 0.0, 0.0]]), np.zeros(1), 401)
    speed = path_speeds(path, np.zeros(1), np.zeros(1), LIMITS, np.ones(1), np.ones(1))[0]
    # A trapezoid: acceleration and braking take v / a each and v^2 / a of distance together; the rest is driven at v.
    expected = LIMITS.v / 1.0 + 1.0 / LIMITS.v
    assert travel_times(path, speed)[0, -1] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("angle", [0.2, -1.0, 3.0])
def test_turn_on_the_spot_satisfies_limits_and_predicted_time(angle):
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


def test_braking_follows_the_arc_of_motion():
    line = MotionLine(np.zeros(3))
    line.brake(0.5, 0.5, 0.5)
    stop = line.trajectory("stop", 0.0)
    end = stop.sample([0.5]).pose[0]
    # The mean speed is half of the initial speed: 0.125 m on a circle of 1 m.
    assert end == pytest.approx([np.sin(0.125), 1 - np.cos(0.125), 0.125], abs=1e-5)


def connect(name, time, across, turn, v=0.0, omega=0.0):
    """Return a pose `across` [m] and `turn` [rad] from the reference at `time` [s], and its return path."""
    reference = REFERENCES[name]
    pose = reference.sample([time]).pose[0]
    pose[:2] += across * np.array([-np.sin(pose[2]), np.cos(pose[2])])
    pose[2] += turn
    window = PathWindow.sample_around(reference, time, 6.0, 0.05)
    nearest = window.nearest(pose, time)
    return (
        pose,
        rejoin(reference, window, nearest, RobotState(pose, v, omega), time, (0.2, 2.0), LIMITS),
        window.times[nearest],
    )


random_offsets = st.tuples(
    st.sampled_from(list(REFERENCES)),
    st.floats(0.0, 9.0),
    st.floats(-0.9, 0.9),
    angles,
    st.floats(-0.5, 0.6),
    st.floats(-1.5, 1.5),
)


@example(("back and forth", 0.25, -0.835, -2.793, 0.596, 1.046))
@settings(max_examples=150)
@given(random_offsets)
def test_return_path_connects_any_pose_to_the_reference(offset):
    pose, path, nearest = connect(*offset)
    reference = path.reference
    # The path starts at the robot.
    first = path.sample([path.starts])
    assert first.pose[0, :2] == pytest.approx(pose[:2], abs=1e-9)
    assert wrap_angle(first.pose[0, 2] - pose[2]) == pytest.approx(0.0, abs=1e-6)
    # The path is continuous.
    times = np.arange(path.starts, path.joins + 0.3, 0.002)
    sample = path.sample(times)
    assert np.isfinite(sample.pose).all()
    assert np.hypot(*np.diff(sample.pose[:, :2], axis=0).T).max() < 0.0101 + 0.002
    assert np.abs(np.diff(sample.pose[:, 2])).max() < 0.01
    assert (np.diff(sample.arc_length) >= -1e-9).all()
    # The path ends on the reference ahead of the robot.
    assert path.joins >= nearest
    at_join = reference.sample([path.joins])
    assert path.sample([path.joins]).pose == pytest.approx(at_join.pose)
    last = path.connection.sample([path.connection.duration]).pose[0]
    assert np.hypot(*(last - at_join.pose[0])[:2]) <= 0.0101  # within this distance the robot only turns
    assert last[2] == pytest.approx(at_join.pose[0, 2], abs=1e-6)
    # Splines may slightly exceed the limits between their nodes.
    assert np.abs(sample.twist[times < path.joins, 0]).max() <= LIMITS.v * 1.02
    assert np.abs(sample.twist[times < path.joins, 1]).max() <= LIMITS.omega * 1.05
    assert 0 < path.connection.duration < 12.0


# The reference has cruise speed over the maximum length of a return path.
@settings(max_examples=60)
@given(
    st.sampled_from([("circle", 4.0), ("circle", 7.5), ("s", 5.5), ("backwards", 2.0)]),
    st.floats(-0.3, 0.3),
    st.floats(-0.4, 0.4),
)
def test_return_path_to_a_moving_reference_has_its_twist_at_both_ends(case, across, turn):
    name, time = case
    twist = REFERENCES[name].sample([time]).twist[0]
    _, path, _ = connect(name, time, across, turn, *twist)
    # The return path starts at the robot's speed, reduced if its first curve is too tight, and ends with the speed and
    # curvature of the reference; a difference of 0.16 m/s is 0.08 s of command slew.
    start, end = path.connection.sample([0.0]), path.connection.sample([path.connection.duration])
    assert start.twist[0, 0] == pytest.approx(twist[0], abs=0.16)
    assert end.twist[0] == pytest.approx(REFERENCES[name].sample([path.joins]).twist[0], abs=0.1)
    # The robot never stops or reverses.
    times = np.linspace(0.0, path.connection.duration, 400)
    speeds = np.sign(twist[0]) * path.connection.sample(times).twist[:, 0]
    assert speeds.min() > 0.1


DT = 0.0202
MODEL = load_model("ssm").discretise(DT)
BAND = 0.05
SLEW = np.array([2.0, 6.0]) * DT


def drive(reference, seconds, *, start=(0.0, 0.0), noise=0.0, held=None, move=None, base=None, slip=None, **overrides):
    """Run the loop with a robot that starts at an offset `start` (across [m], turn [rad]) from the reference.

    `held` = (start, end): the robot does not move in this interval.
    `move(k, pose)` may return another pose. `base(command)` returns the twist that the wheels reach.
    Return results, true poses and times.
    """
    controller = Controller(load_config("ssm", PROMPT | overrides))
    pose = offset_pose(reference, 0.0, *start)
    robot = IdealRobot(MODEL, pose, noise=noise, slip=slip)
    controller.start(reference, 0.0)
    results, poses, times, applied = [], [], [], None
    for k in range(round(seconds / DT)):
        t = robot.time
        if move is not None and (new_pose := move(k, robot.pose)) is not None:
            robot.poses = [new_pose] * (robot.late + 1)
        measurement = robot.measure()
        if applied is not None:
            measurement = replace(measurement, sent=applied)
        result = controller.step(t, measurement)
        results.append(result)
        poses.append(robot.pose.copy())
        times.append(t)
        applied = tuple(result.command)
        if held is not None and held[0] <= t < held[1]:
            robot.state[:] = 0.0
            robot.line.append(np.zeros(2))
            robot.poses.append(robot.pose.copy())
            robot.k += 1
        else:
            robot.advance(result.command if base is None else base(result.command))
    return results, np.array(poses), np.array(times)


def offset_pose(reference, time, across, turn):
    pose = reference.sample([time]).pose[0]
    return pose + [-across * np.sin(pose[2]), across * np.cos(pose[2]), turn]


def lateral_errors(reference, results, poses, times):
    """Return the signed distance of each pose from the path near the reference, positive to its left [m]."""
    grid = np.linspace(0.0, reference.duration, 6000)
    path = reference.sample(grid).pose
    offsets = []
    for result, pose, t in zip(results, poses, times, strict=True):
        is_near = np.abs(grid - (t - result.reference_delay)) < 2.0
        offset = pose[:2] - path[is_near, :2]
        nearest = int(np.argmin(np.hypot(*offset.T)))
        heading = path[is_near][nearest, 2]
        offsets.append(
            np.copysign(
                np.hypot(*offset[nearest]), np.cos(heading) * offset[nearest, 1] - np.sin(heading) * offset[nearest, 0]
            )
        )
    return np.array(offsets)


def return_time_and_overshoot(distance, times, start):
    """Return the time [s] from `start` until the robot stays in the band, and the overshoot after the maximum error."""
    is_after = times >= start
    outside_band = np.flatnonzero(is_after & (np.abs(distance) > BAND))
    peak = np.flatnonzero(is_after)[np.argmax(np.abs(distance[is_after]))]
    return times[outside_band[-1]] - start, float(np.max(-np.sign(distance[peak]) * distance[peak:]))


def satisfies_slew(results):
    return (np.abs(np.diff([r.command for r in results], axis=0)) <= SLEW + 1e-9).all()


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_reentry_does_not_change_commands_within_the_band(name):
    reference = load_trajectory(name)
    enabled, poses, _ = drive(reference, 6.0, noise=1.0)
    disabled, disabled_poses, _ = drive(reference, 6.0, noise=1.0, **{"reentry.enabled": False})
    assert (poses == disabled_poses).all()
    assert all((a.command == b.command).all() for a, b in zip(enabled, disabled, strict=True))
    assert {(r.progress, r.reference_delay, r.message) for r in enabled} == {(1.0, 0.0, "")}


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane", "backwards"])
@pytest.mark.parametrize(("across", "turn"), [(0.2, 0.35), (0.2, -0.35), (-0.2, 0.35), (-0.2, -0.35)])
def test_robot_started_off_the_path_returns_in_time_without_overshoot(name, across, turn):
    reference = REFERENCES[name]
    results, poses, times = drive(reference, 6.0, start=(across, turn), noise=1.0)
    distance = lateral_errors(reference, results, poses, times)
    return_time, overshoot = return_time_and_overshoot(distance, times, 0.0)
    assert return_time <= 3.0
    assert overshoot <= BAND
    assert {r.mode for r in results} == {Mode.TRACKING}
    assert satisfies_slew(results)
    assert np.mean([r.command[0] for r in results]) * reference.sample([1.0]).twist[0, 0] > 0.04
    # The command exceeds the speed of the reference only slightly.
    assert np.max([abs(r.command[0]) for r in results]) < 0.5 * 1.25 + 0.15
    assert "outside the band" in results[0].message
    assert "rejoining" in results[0].message


def test_kidnapped_robot_turns_first_and_then_drives_back():
    reference = load_trajectory("circle")

    def kidnap(k, pose):
        return pose + [-0.8 * np.sin(pose[2]), 0.8 * np.cos(pose[2]), np.pi] if k == 200 else None

    results, poses, times = drive(reference, 13.0, move=kidnap)
    distance = lateral_errors(reference, results, poses, times)
    sequence = [r.mode for k, r in enumerate(results) if k == 0 or r.mode != results[k - 1].mode]
    assert sequence == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    rejoining = [k for k, r in enumerate(results) if "rejoining" in r.message]
    assert satisfies_slew(results[rejoining[0] :])
    # The robot does not drive while it faces away from the path.
    tangent = np.array([results[k].reference[-1, 2] for k in rejoining])
    facing_away = np.abs(wrap_angle(poses[rejoining, 2] - tangent)) > 0.6 * np.pi
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T)[np.array(rejoining)] / DT
    assert speed[facing_away][20:].max(initial=0.0) < 0.2
    assert np.abs(distance[-100:]).max() < 0.02
    assert results[-1].reference_delay > 0


def test_reference_waits_for_a_blocked_robot_and_command_stays_small():
    reference = load_trajectory("s")
    results, poses, times = drive(reference, 14.0, held=(5.0, 8.0))
    is_blocked = (times > 6.5) & (times < 8.0)
    commands = np.array([r.command for r in results])
    delays = np.array([r.reference_delay for r in results])
    assert (np.abs(commands[is_blocked]) <= 0.4 * np.array([1.5, 2.0]) + 1e-9).all()
    assert all("blocked for" in r.message for r, w in zip(results, is_blocked, strict=True) if w)
    assert max(r.progress for r, w in zip(results, is_blocked, strict=True) if w) < 0.01
    # After release the robot stays on the path without a jump; the reference catches up within its rate.
    assert 2.0 < delays.max() < 3.5
    assert np.abs(lateral_errors(reference, results, poses, times)[times > 8.0]).max() < BAND
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / DT
    assert speed[times[1:] > 8.0].max() < 1.0
    assert (np.diff(delays) >= -0.25 * DT - 1e-9).all()
    assert delays[-1] < delays.max() - 0.5
    assert {r.mode for r in results} == {Mode.TRACKING}


@pytest.mark.parametrize("slip", [Slip(turn_ahead=0.12), Slip(turn_ahead=-0.12), Slip(slide_x=0.12)])
def test_displacement_by_a_turn_on_the_spot_does_not_start_reentry(slip):
    """The robot turns about a point 12 cm away or slides 12 cm per radian, and returns to the band without re-entry."""
    reference = load_trajectory("square")
    results, poses, times = drive(reference, reference.duration, slip=slip)
    distance = np.hypot(*(poses - reference.sample(times).pose)[:, :2].T)
    assert distance.max() > 0.08
    assert not any("rejoining" in result.message for result in results)
    straight = reference.sample(times).twist[:, 0] > 0.4
    ends = np.flatnonzero(straight[:-1] & ~straight[1:])
    assert ends.size == 4
    assert (distance[ends] < 0.5 * distance.max()).all()


def test_robot_too_far_from_the_reference_stops_and_reports_the_distance():
    results, _, _ = drive(load_trajectory("circle"), 0.5, start=(-1.4, 0.0))
    assert {r.mode for r in results} == {Mode.STOPPED}
    assert "1.40 m from the reference; the limit is 1.0 m" in results[-1].message


def wheels(max_speed=np.inf, share=(1.0, 1.0), end=np.inf, turning=False):
    """Return a base whose right and left wheels reach `share` of their command, at most `max_speed` [m/s].

    `max_speed` applies until `end` [s], and only during turns on the spot if `turning`.
    """
    half_track, ticks = 0.5 * load_config("ssm").wheels.track, count()

    def base(command):
        v, omega = command
        limit = max_speed if next(ticks) * DT < end and (abs(v) < 0.1 or not turning) else np.inf
        right, left = np.clip([v + half_track * omega, v - half_track * omega] * np.array(share), -limit, limit)
        return np.array([right + left, (right - left) / (2 * half_track)]) / [2, 1]

    return base


def max_path_error(reference, poses):
    path = reference.sample(np.linspace(0, reference.duration, 5000)).pose[:, :2]
    return max(np.hypot(*(path - pose[:2]).T).min() for pose in poses)


def reports_slow_wheels(results):
    return np.array(["the wheels get no faster than" in result.message for result in results])


@pytest.mark.parametrize("path", ["circle", "s", "slalom"])
def test_robot_with_slow_wheels_stays_on_its_path_with_delay(path):
    """The outer wheel cannot follow: a higher command of v or omega would only straighten the curve."""
    reference = load_trajectory(path)
    results, poses, _ = drive(reference, 1.2 * reference.duration, base=wheels(max_speed=0.44))
    assert max_path_error(reference, poses) < 0.06
    assert results[-1].reference_delay > 0.1 * reference.duration
    assert reports_slow_wheels(results).any()
    assert all(result.mode is Mode.TRACKING for result in results)


def test_recovered_wheels_are_used_again_within_a_second():
    results, _, times = drive(load_trajectory("circle"), 9.0, base=wheels(max_speed=0.44, end=6.0))
    progress = np.array([result.progress for result in results])
    assert progress[(times > 2.0) & (times < 6.0)].mean() < 0.8
    # The controller tries higher speeds after 1 s, and the rate rises within 0.5 s.
    assert progress[times > 7.5].min() >= 1.0


@pytest.mark.parametrize("monitored", [True, False])
def test_speed_limit_of_a_turn_on_the_spot_ends_with_the_turn(monitored):
    reference = load_trajectory("square")
    base = wheels(max_speed=0.08, turning=True)
    results, _, times = drive(reference, 13.0, base=base, **{"monitor.wheel_limits": monitored})
    # In the first turn, slow wheels cannot be distinguished from a lower gain.
    assert reports_slow_wheels(results).any() == monitored
    path_speed = reference.sample(times - [result.reference_delay for result in results]).twist[:, 0]
    leaves = times[(times > 9.0) & (path_speed > 0.0)][0]
    assert results[round((leaves + 1.0) / DT)].progress >= 1.0


@pytest.mark.parametrize("share", [(0.6, 0.6), (1.0, 0.9)])
def test_weak_wheels_are_compensated_and_the_drive_finishes(share):
    reference = load_trajectory("circle")
    results, poses, _ = drive(reference, 1.5 * reference.duration + 8.0, base=wheels(share=share))
    assert max_path_error(reference, poses) < 0.08
    assert results[-1].mode is Mode.FINISHED


@pytest.mark.parametrize("path", ["circle", "square", "slalom", "k_turn"])
def test_wheels_that_follow_their_commands_are_not_reported(path):
    results, _, _ = drive(load_trajectory(path), 8.0, noise=1.0)
    assert not any("the wheels" in result.message for result in results)
