"""References from planned paths: distance to the plan, limits, stops and turns on the spot."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.planned.planned_path import time_poses
from refusals import one_line_error

LIMITS = TrajectoryLimits(v=0.6, omega=0.8, v_acceleration=0.5, omega_acceleration=1.5)
DEVIATION = 0.05
AT_ORIGIN = np.zeros(3)
X = np.linspace(0.0, 3.0, 61)


def lay(poses, robot=AT_ORIGIN, limits=LIMITS, **options):
    return time_poses(
        np.array(poses, dtype=float), limits, robot=np.array(robot), deviation=DEVIATION, max_offset=0.08, **options
    )


def grid_cells(corners, cell=0.05):
    """Return cells from corner to corner, as from a planner on an eight-connected grid."""
    cells = [np.round(np.array(corners[0]) / cell)]
    for corner in corners[1:]:
        first, last = cells[-1], np.round(np.array(corner) / cell)
        count = int(np.abs(last - first).max())
        cells += [np.round(first + (last - first) * i / count) for i in range(1, count + 1)]
    return np.array(cells) * cell


def with_headings(points, goal=None):
    step = np.diff(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points, np.append(heading, heading[-1] if goal is None else goal)])


def sample_plan(plan):
    times = np.linspace(0.0, plan.reference.duration, 2 + int(plan.reference.duration / 0.005))
    return times, plan.reference.sample(times)


def distance(points, line):
    """Return the distance (n,) of points from a line of chords."""
    start, step = line[:-1], np.diff(line, axis=0)
    gap = points[:, None] - start
    share = np.clip((gap * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-12), 0.0, 1.0)
    return np.hypot(*(gap - share[..., None] * step).transpose(2, 0, 1)).min(axis=1)


def check(result, poses, limits=LIMITS):
    """Check limits, motion without lateral slip, deviation and end of a reference."""
    times, sample = sample_plan(result)
    assert np.all(np.abs(sample.twist).max(axis=0) <= np.array([limits.v, limits.omega]) * 1.01 + 1e-9)
    acceleration = np.abs(np.diff(sample.twist, axis=0) / np.diff(times)[:, None])
    assert np.all(acceleration.max(axis=0) <= np.array([limits.v_acceleration, limits.omega_acceleration]) * 1.05)
    step = np.diff(sample.pose, axis=0)
    heading = sample.pose[:-1, 2] + step[:, 2] / 2
    assert np.abs(np.cos(heading) * step[:, 1] - np.sin(heading) * step[:, 0]).max() < 1e-4
    assert result.deviation <= DEVIATION * 1.001
    end = sample.pose[-1]
    assert np.allclose(end[:2], poses[-1][:2], atol=1e-6)
    assert abs(math.remainder(end[2] - poses[-1][2], math.tau)) < 2e-3
    assert np.abs(sample.twist[-1]).max() < 1e-6
    return sample


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (3, 0.2)],
        [(0, 0), (1, 0), (1, 1)],
        [(0, 0), (2, 1.3), (4, 1.3), (4, 3)],
        [(0, 0), (1.5, 1.0), (0.5, 2.5), (-1.0, 0.5)],
    ],
    ids=["shallow", "corner", "rooms", "back"],
)
@pytest.mark.parametrize("has_headings", [True, False], ids=["headings", "identities"])
def test_staircase_of_cells_gives_a_feasible_path_near_it(corners, has_headings):
    points = grid_cells(corners)
    poses = with_headings(points, 0.3)
    if not has_headings:
        poses[:-1, 2] = 0.0
    result = lay(poses)
    sample = check(result, poses)
    assert distance(sample.pose[::5, :2], points).max() <= DEVIATION * 1.001
    # The path does not follow stair steps: the heading turns only as much as corners and goal require.
    required = np.abs(np.diff(np.unwrap(with_headings(np.array(corners, dtype=float), 0.3)[:, 2]))).sum()
    assert np.abs(np.diff(sample.pose[:, 2])).sum() < required + abs(float(with_headings(points)[0, 2])) + 1.0
    assert sample.twist[:, 0].min() > -1e-9
    assert result.reference.duration < 3.5 * result.length / LIMITS.v + 8.0


def test_poses_against_the_travel_direction_are_driven_backwards():
    forwards = np.column_stack([X / 3, 0 * X, 0 * X])
    backwards = np.column_stack([1 - X[1:] / 3, 0.3 * (X[1:] / 3) ** 2, -0.6 * X[1:] / 3])
    poses = np.concatenate([forwards, backwards])
    result = lay(poses)
    sample = check(result, poses)
    assert sample.twist[:, 0].min() < -0.3 and sample.twist[:, 0].max() > 0.3
    cusp = int(np.argmax(sample.pose[:, 0]))
    assert sample.pose[cusp, 0] == pytest.approx(1.0, abs=1e-3)
    assert abs(sample.twist[cusp, 0]) < 0.02
    assert np.abs(sample.pose[:, 2]).max() < 0.7


def test_robot_turns_around_if_reversing_is_forbidden():
    forwards = np.column_stack([X / 3, 0 * X, 0 * X])
    poses = np.concatenate([forwards, np.column_stack([1 - X[1:] / 3, 0 * X[1:], 0 * X[1:]])])
    assert check(lay(poses), poses).twist[:, 0].min() < -0.3
    sample = check(lay(poses, backwards=False), poses)
    assert sample.twist[:, 0].min() > -1e-9
    assert np.ptp(sample.pose[:, 2]) > 3.0


def test_missing_headings_do_not_cause_reversing():
    points = grid_cells([(0, 0), (-2, 0.5), (-2, 2)])
    poses = np.column_stack([points, np.zeros(len(points))])
    poses[-1, 2] = 1.0
    assert check(lay(poses), poses).twist[:, 0].min() > -1e-9
    # The direction of a straight path along the axis follows from the heading of the robot.
    straight = np.column_stack([-X, 0 * X, 0 * X])
    assert check(lay(straight, (0.0, 0.0, math.pi)), straight).twist[:, 0].min() > -1e-9
    assert check(lay(straight), straight).twist[:, 0].max() < 1e-9


@pytest.mark.parametrize("goal", [0.2, 1.0, -2.5, math.pi])
def test_heading_of_the_goal_is_reached(goal):
    poses = with_headings(np.column_stack([X, 0 * X]), goal)
    sample = check(lay(poses), poses)
    turning = np.abs(sample.twist[:, 1]) > 1e-3
    on_the_spot = turning & (np.abs(sample.twist[:, 0]) < 1e-6)
    assert on_the_spot.any() == (goal != 0.2)
    assert np.allclose(sample.pose[on_the_spot, 0], 3.0, atol=1e-6)


def test_rotating_poses_at_one_position_give_a_turn_on_the_spot():
    turn = [(1.0, 0.0, angle) for angle in np.linspace(0.0, 1.5, 6)]
    poses = [*((x, 0.0, 0.0) for x in X[:20] / X[20]), *turn, *((1.0, y, math.pi / 2) for y in X[1:21])]
    sample = check(lay(poses), poses)
    turning = np.abs(sample.twist[:, 1]) > 0.3
    assert np.hypot(*(sample.pose[turning, :2] - (1.0, 0.0)).T).max() < 0.02


def test_robot_at_rest_that_faces_away_turns_first():
    poses = with_headings(np.column_stack([X, 0 * X]))
    sample = check(lay(poses, (0.0, 0.0, 2.0)), poses)
    assert sample.pose[0, 2] == pytest.approx(2.0) and sample.twist[:, 0].min() > -1e-9
    assert np.abs(sample.twist[0]).max() < 1e-6
    moving = lay(poses, (0.0, 0.0, 1.0), twist=(0.4, 0.0))
    assert sample_plan(moving)[1].twist[0, 0] == pytest.approx(0.4 * math.cos(1.0), abs=0.05)


def test_path_starts_at_the_pose_and_speed_of_the_robot():
    poses = with_headings(np.column_stack([X, 0 * X]))
    robot = np.array([0.62, 0.03, 0.1])
    result = lay(poses, robot, twist=(0.45, 0.0))
    sample = check(result, poses)
    assert np.allclose(sample.pose[0], robot, atol=0.03)
    assert sample.twist[0, 0] == pytest.approx(0.45, abs=0.01)
    assert result.length == pytest.approx(3.0 - 0.62, abs=0.02)
    assert np.abs(sample.pose[:, 1]).max() < 0.03 + DEVIATION
    assert np.abs(sample.pose[sample.pose[:, 0] > 2.0, 1]).max() < 0.03


def test_closed_path_is_not_shortened():
    angle = np.linspace(0.0, math.tau, 126)
    poses = with_headings(np.column_stack([np.sin(angle), 1.0 - np.cos(angle)]))
    assert lay(poses).length == pytest.approx(math.tau, rel=0.01)


def test_path_has_no_turns_on_the_spot_if_they_are_forbidden():
    limits = TrajectoryLimits(0.6, 0.8, 0.5, 1.5, min_turn_radius=0.5)
    result = lay(with_headings(np.column_stack([X, 0 * X]), 1.0), (0.0, 0.0, 1.0), limits)
    sample = sample_plan(result)[1]
    assert np.abs(sample.twist[np.abs(sample.twist[:, 0]) < 1e-3, 1]).max() < 0.01


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((0, 3)), "0 poses"),
        ([(0.0, 0.0, 0.0), (math.nan, 1.0, 0.0)], "pose 1 is not finite"),
        ([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)], "one position"),
    ],
)
def test_unusable_poses_raise_error_in_one_line(poses, message):
    with one_line_error(ConfigError, message):
        lay(np.array(poses).reshape(-1, 3))


def test_long_zigzag_is_rejected():
    steps = np.arange(10_000)
    with pytest.raises(ConfigError, match="reverses 9998 times"):
        lay(np.column_stack([0.05 * steps, 0.2 * (steps % 2), 0.0 * steps]))


@given(
    st.lists(st.tuples(st.integers(-40, 40), st.integers(-40, 40)), min_size=2, max_size=6, unique=True),
    st.floats(-3.1, 3.1),
    st.floats(-3.1, 3.1),
)
def test_reference_from_any_cells_satisfies_its_limits_or_raises_error(corners, goal, heading):
    points = grid_cells([(0.05 * x, 0.05 * y) for x, y in corners])
    poses = with_headings(points, goal)
    try:
        result = lay(poses, (*points[0], heading))
    except ConfigError as error:
        assert "\n" not in str(error)
        return
    check(result, poses)
