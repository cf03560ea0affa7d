"""Re-entry: the paths back, and the loop that drives them."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from hypothesis import given, settings
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
def test_quintic_path_meets_pose_and_curvature_at_both_ends(start, start_bend, shift, end_bend):
    start, end = np.array(start), np.array(start) + shift
    nodes = 4001
    path = quintic_paths(start[None], np.array([start_bend]), end[None], np.array([end_bend]), nodes)
    for index, pose, bend in ((0, start, start_bend), (-1, end, end_bend)):
        assert path.points[0, index] == pytest.approx(pose[:2], abs=1e-9)
        assert wrap_angle(path.heading[0, index] - pose[2]) == pytest.approx(0.0, abs=1e-6)
        assert path.curvature[0, index] == pytest.approx(bend, abs=1e-6)


@given(st.floats(-1.5, 1.5), bends, bends)
def test_heading_curvature_and_length_match_the_points(angle, start_bend, end_bend):
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
def test_speeds_keep_every_limit_on_every_piece(end, bend, enter, leave):
    path = quintic_paths(np.zeros((1, 3)), np.array([bend]), np.array([end]), np.zeros(1), 33)
    speed = path_speeds(path, np.array([enter]), np.array([leave]), LIMITS, np.ones(1), np.ones(1))[0, 0]
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
    for piece_ends in (slice(None, -1), slice(1, None)):
        yaw = np.abs(change) * speed[piece_ends] ** 2 + np.abs(k[piece_ends] * acceleration)
        assert yaw.max() <= LIMITS.omega_acceleration * slack
    assert travel_times(path, speed[None])[0, -1] >= ds.sum() / LIMITS.v * (1 - 1e-6)


def test_straight_from_rest_to_rest_takes_the_shortest_time():
    path = quintic_paths(np.zeros((1, 3)), np.zeros(1), np.array([[1.0, 0.0, 0.0]]), np.zeros(1), 401)
    speed = path_speeds(path, np.zeros(1), np.zeros(1), LIMITS, np.ones(1), np.ones(1))[0]
    # A trapezoid: v / a to reach the speed, and as long to leave it, with v^2 / a of way; the rest at v.
    expected = LIMITS.v / 1.0 + 1.0 / LIMITS.v
    assert travel_times(path, speed)[0, -1] == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("angle", [0.2, -1.0, 3.0])
def test_turn_on_the_spot_keeps_limits_and_predicted_time(angle):
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
    # Mean speed half of the first: 0.125 m on a circle of 1 m.
    assert end == pytest.approx([np.sin(0.125), 1 - np.cos(0.125), 0.125], abs=1e-5)


def connect(name, time, across, turned, v=0.0, omega=0.0):
    """Return a pose `across` [m] and `turned` [rad] from the reference at `time` [s], and its way back."""
    reference = REFERENCES[name]
    pose = reference.sample([time]).pose[0]
    pose[:2] += across * np.array([-np.sin(pose[2]), np.cos(pose[2])])
    pose[2] += turned
    window = PathWindow.sample_around(reference, time, 6.0, 0.05)
    nearest = window.nearest(pose, time)
    return (
        pose,
        rejoin(reference, window, nearest, RobotState(pose, v, omega), time, (0.2, 2.0), LIMITS),
        window.times[nearest],
    )


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
def test_way_back_connects_any_pose_to_the_reference(where):
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
def test_way_back_to_a_moving_reference_keeps_course_and_joins_its_twist(where, across, turned):
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


DT = 0.0202
MODEL = load_model("ssm").discretise(DT)
BAND = 0.05
SLEW = np.array([2.0, 6.0]) * DT


def drive(reference, seconds, *, start=(0.0, 0.0), noise=0.0, held=None, move=None, base=None, slip=None, **overrides):
    """Run the loop with a robot that starts `start` (across [m], turned [rad]) beside the reference.

    `held` = (from, to): it does not move.
    `move(k, pose)` may put it elsewhere. `base(command)` is what its wheels make of a command.
    Returns results, true poses and times.
    """
    controller = Controller(load_config("ssm", PROMPT | overrides))
    pose = beside(reference, 0.0, *start)
    robot = IdealRobot(MODEL, pose, noise=noise, slip=slip)
    controller.start(reference, 0.0)
    results, poses, times, applied = [], [], [], None
    for k in range(round(seconds / DT)):
        t = robot.time
        if move is not None and (elsewhere := move(k, robot.pose)) is not None:
            robot.poses = [elsewhere] * (robot.late + 1)
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


def beside(reference, time, across, turned):
    pose = reference.sample([time]).pose[0]
    return pose + [-across * np.sin(pose[2]), across * np.cos(pose[2]), turned]


def lateral(reference, results, poses, times):
    """Return the signed distance from the path near the reference, positive to its left."""
    fine = np.linspace(0.0, reference.duration, 6000)
    path = reference.sample(fine).pose
    out = []
    for result, pose, t in zip(results, poses, times, strict=True):
        near = np.abs(fine - (t - result.reference_delay)) < 2.0
        offset = pose[:2] - path[near, :2]
        nearest = int(np.argmin(np.hypot(*offset.T)))
        heading = path[near][nearest, 2]
        out.append(
            np.copysign(
                np.hypot(*offset[nearest]), np.cos(heading) * offset[nearest, 1] - np.sin(heading) * offset[nearest, 0]
            )
        )
    return np.array(out)


def back_and_overshoot(away, times, since):
    """Return the time [s] after `since` from which the robot stays in the band, and its overshoot after that."""
    after = times >= since
    outside = np.flatnonzero(after & (np.abs(away) > BAND))
    worst = np.flatnonzero(after)[np.argmax(np.abs(away[after]))]
    return times[outside[-1]] - since, float(np.max(-np.sign(away[worst]) * away[worst:]))


def smooth(results):
    return (np.abs(np.diff([r.command for r in results], axis=0)) <= SLEW + 1e-9).all()


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_reentry_changes_no_bit_within_the_band(name):
    reference = load_trajectory(name)
    with_it, poses, _ = drive(reference, 6.0, noise=1.0)
    without, plain, _ = drive(reference, 6.0, noise=1.0, **{"reentry.enabled": False})
    assert (poses == plain).all()
    assert all((a.command == b.command).all() for a, b in zip(with_it, without, strict=True))
    assert {(r.progress, r.reference_delay, r.message) for r in with_it} == {(1.0, 0.0, "")}


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane", "backwards"])
@pytest.mark.parametrize(("across", "turned"), [(0.2, 0.35), (0.2, -0.35), (-0.2, 0.35), (-0.2, -0.35)])
def test_robot_started_off_the_path_returns_in_time_without_overshoot(name, across, turned):
    reference = REFERENCES[name]
    results, poses, times = drive(reference, 6.0, start=(across, turned), noise=1.0)
    away = lateral(reference, results, poses, times)
    back, over = back_and_overshoot(away, times, 0.0)
    assert back <= 3.0
    assert over <= BAND
    assert {r.mode for r in results} == {Mode.TRACKING}
    assert smooth(results)
    assert np.mean([r.command[0] for r in results]) * reference.sample([1.0]).twist[0, 0] > 0.04
    # Not at full command: little more than the reference's own speed.
    assert np.max([abs(r.command[0]) for r in results]) < 0.5 * 1.25 + 0.15
    assert "outside the band" in results[0].message
    assert "rejoining" in results[0].message


def test_kidnapped_robot_turns_first_and_then_drives_back():
    reference = load_trajectory("circle")

    def kidnap(k, pose):
        return pose + [-0.8 * np.sin(pose[2]), 0.8 * np.cos(pose[2]), np.pi] if k == 200 else None

    results, poses, times = drive(reference, 13.0, move=kidnap)
    away = lateral(reference, results, poses, times)
    sequence = [r.mode for k, r in enumerate(results) if k == 0 or r.mode != results[k - 1].mode]
    assert sequence == [Mode.TRACKING, Mode.BRAKING, Mode.STOPPED, Mode.TRACKING]
    on_the_way = [k for k, r in enumerate(results) if "rejoining" in r.message]
    assert smooth(results[on_the_way[0] :])
    # It does not drive as long as it faces the other way.
    tangent = np.array([results[k].reference[-1, 2] for k in on_the_way])
    astray = np.abs(wrap_angle(poses[on_the_way, 2] - tangent)) > 0.6 * np.pi
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T)[np.array(on_the_way)] / DT
    assert speed[astray][20:].max(initial=0.0) < 0.2
    assert np.abs(away[-100:]).max() < 0.02
    assert results[-1].reference_delay > 0


def test_reference_waits_for_a_blocked_robot_and_command_stays_small():
    reference = load_trajectory("s")
    results, poses, times = drive(reference, 14.0, held=(5.0, 8.0))
    within = (times > 6.5) & (times < 8.0)
    commands = np.array([r.command for r in results])
    delays = np.array([r.reference_delay for r in results])
    assert (np.abs(commands[within]) <= 0.4 * np.array([1.5, 2.0]) + 1e-9).all()
    assert all("blocked for" in r.message for r, w in zip(results, within, strict=True) if w)
    assert max(r.progress for r, w in zip(results, within, strict=True) if w) < 0.01
    # Let go, it neither leaps nor leaves the path; the reference catches up no faster than it may.
    assert 2.0 < delays.max() < 3.5
    assert np.abs(lateral(reference, results, poses, times)[times > 8.0]).max() < BAND
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / DT
    assert speed[times[1:] > 8.0].max() < 1.0
    assert (np.diff(delays) >= -0.25 * DT - 1e-9).all()
    assert delays[-1] < delays.max() - 0.5
    assert {r.mode for r in results} == {Mode.TRACKING}


def test_robot_pushed_near_the_end_still_arrives():
    """Pushed sideways just before the end: the reference ends later, and so does the finish."""
    reference = load_trajectory("cane")
    tick = round((reference.duration - 0.8) / DT)

    def push(k, pose):
        return pose + [-0.2 * np.sin(pose[2]), 0.2 * np.cos(pose[2]), 0.0] if k == tick else None

    results, poses, _ = drive(reference, reference.duration + 8.0, move=push)
    assert results[-1].mode is Mode.FINISHED
    assert "not at rest" not in results[-1].message
    end = reference.sample([reference.duration]).pose[0]
    assert np.hypot(*(poses[-1] - end)[:2]) < 0.03
    assert abs(wrap_angle(poses[-1, 2] - end[2])) < 0.06
    delays = {round(r.reference_delay, 9) for r in results if r.mode is Mode.FINISHED}
    assert len(delays) == 1


def test_robot_carried_ahead_waits_instead_of_reversing():
    reference = load_trajectory("circle")

    def carry(k, pose):
        ahead = reference.sample([k * DT + 0.5]).pose[0]
        return ahead if k == 200 else None

    results, poses, times = drive(reference, 12.0, move=carry, **{"estimator.max_position_jump": 0.6})
    after = times > 200 * DT
    assert np.min([r.command[0] for r, a in zip(results, after, strict=True) if a]) > -0.05
    assert np.abs(lateral(reference, results, poses, times)).max() < BAND
    assert results[-1].reference_delay == 0.0


@pytest.mark.parametrize("slip", [Slip(turn_ahead=0.12), Slip(turn_ahead=-0.12), Slip(slide_x=0.12)])
def test_displacement_by_a_turn_on_the_spot_does_not_start_reentry(slip):
    """It turns about a point 12 cm off, or slides 12 cm for each radian: outside of the band, and back on its own."""
    reference = load_trajectory("square")
    results, poses, times = drive(reference, reference.duration, slip=slip)
    away = np.hypot(*(poses - reference.sample(times).pose)[:, :2].T)
    assert away.max() > 0.08
    assert not any("rejoining" in result.message for result in results)
    straight = reference.sample(times).twist[:, 0] > 0.4
    ends = np.flatnonzero(straight[:-1] & ~straight[1:])
    assert ends.size == 4
    assert (away[ends] < 0.5 * away.max()).all()


def test_robot_too_far_from_the_reference_stops_and_reports_the_distance():
    results, _, _ = drive(load_trajectory("circle"), 0.5, start=(-1.4, 0.0))
    assert {r.mode for r in results} == {Mode.STOPPED}
    assert "1.40 m from the reference; the limit is 1.0 m" in results[-1].message


def wheels(most=np.inf, share=(1.0, 1.0), until=np.inf, turning=False):
    """Return a base whose right and left wheels do `share` of their command, at most `most` [m/s].

    `most` applies up to the time `until` [s], and only while it turns on the spot if `turning`.
    """
    half_track, ticks = 0.5 * load_config("ssm").wheels.track, count()

    def base(command):
        v, omega = command
        limit = most if next(ticks) * DT < until and (abs(v) < 0.1 or not turning) else np.inf
        right, left = np.clip([v + half_track * omega, v - half_track * omega] * np.array(share), -limit, limit)
        return np.array([right + left, (right - left) / (2 * half_track)]) / [2, 1]

    return base


def off_the_path(reference, poses):
    drawn = reference.sample(np.linspace(0, reference.duration, 5000)).pose[:, :2]
    return max(np.hypot(*(drawn - pose[:2]).T).min() for pose in poses)


def slowed_by_wheels(results):
    return np.array(["the wheels get no faster than" in result.message for result in results])


@pytest.mark.parametrize("path", ["circle", "s", "slalom"])
def test_robot_with_slow_wheels_stays_on_its_path_and_is_late(path):
    """The outer wheel cannot follow: a higher command of either speed would only straighten the curve."""
    reference = load_trajectory(path)
    results, poses, _ = drive(reference, 1.2 * reference.duration, base=wheels(most=0.44))
    assert off_the_path(reference, poses) < 0.06
    assert results[-1].reference_delay > 0.1 * reference.duration
    assert slowed_by_wheels(results).any()
    assert all(result.mode is Mode.TRACKING for result in results)


def test_wheels_that_recover_are_asked_for_more_within_a_second():
    results, _, times = drive(load_trajectory("circle"), 9.0, base=wheels(most=0.44, until=6.0))
    progress = np.array([result.progress for result in results])
    assert progress[(times > 2.0) & (times < 6.0)].mean() < 0.8
    # 1 s until they are asked, and 0.5 s for the rate to rise.
    assert progress[times > 7.5].min() >= 1.0


@pytest.mark.parametrize("watched", [True, False])
def test_limit_of_a_turn_on_the_spot_ends_with_the_turn(watched):
    reference = load_trajectory("square")
    base = wheels(most=0.08, turning=True)
    results, _, times = drive(reference, 13.0, base=base, **{"monitor.wheel_limits": watched})
    # In the first turn the wheels look like another gain.
    assert slowed_by_wheels(results).any() == watched
    path = reference.sample(times - [result.reference_delay for result in results]).twist[:, 0]
    leaves = times[(times > 9.0) & (path > 0.0)][0]
    assert results[round((leaves + 1.0) / DT)].progress >= 1.0


@pytest.mark.parametrize("share", [(0.6, 0.6), (1.0, 0.9)])
def test_weak_wheels_are_compensated_and_the_drive_finishes(share):
    reference = load_trajectory("circle")
    results, poses, _ = drive(reference, 1.5 * reference.duration + 8.0, base=wheels(share=share))
    assert off_the_path(reference, poses) < 0.08
    assert results[-1].mode is Mode.FINISHED


@pytest.mark.parametrize("path", ["circle", "square", "slalom", "k_turn"])
def test_obedient_wheels_are_not_reported(path):
    results, _, _ = drive(load_trajectory(path), 8.0, noise=1.0)
    assert not any("the wheels" in result.message for result in results)
