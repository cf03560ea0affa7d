"""Paths that would take all memory or hours to lay are refused before; large ones are laid in bounded work."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import ConfigError, integrate_pose, load_trajectory
from diffdrive_mpc.mpc.trajectories.arcs import chained
from diffdrive_mpc.mpc.trajectories.excitation import slip_excitation
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits, load_settings
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments
from diffdrive_mpc.mpc.trajectories.smooth_segments import lay_smooth
from diffdrive_mpc.mpc.trajectories.timed_poses import lay_timed_poses
from diffdrive_mpc.mpc.trajectories.waypoints import lay_waypoints

_LIMITS = TrajectoryLimits.of_robot()


def _wave(count: int) -> list[tuple[float, float]]:
    return [(0.2 * i, 0.3 * math.sin(0.05 * i)) for i in range(count)]


def test_work_does_not_grow_with_the_number_of_close_waypoints() -> None:
    """Ten times as many waypoints make no more pieces, and the same path and speed where both pass."""
    few, many = (lay_waypoints(_wave(count), _LIMITS, name="wave") for count in (1001, 10_001))
    most = load_settings().full_pieces
    assert len(few.breaks) <= most + 1
    assert len(many.breaks) <= most + 1
    times = np.linspace(0.0, 0.5 * few.duration, 200)
    a, b = few.sample(times), many.sample(times)
    assert np.abs(a.pose - b.pose).max() < 1e-3
    assert np.abs(a.twist - b.twist).max() < 1e-3


def test_limits_hold_where_legs_are_cut_into_few_pieces() -> None:
    """Speed, yaw rate and accelerations, by differences of the twist between and at the nodes."""
    path = lay_waypoints(_wave(12_000), _LIMITS, name="wave")
    times = np.arange(10.0, 40.0, 0.001)
    twist = path.sample(times).twist
    rate = np.diff(twist, axis=0) / 0.001
    assert np.abs(twist).max(axis=0) == pytest.approx([_LIMITS.v, 0.0], abs=_LIMITS.omega)
    assert np.abs(twist[:, 0]).max() <= _LIMITS.v * 1.001
    assert np.abs(twist[:, 1]).max() <= _LIMITS.omega * 1.001
    assert np.abs(rate[:, 0]).max() <= _LIMITS.v_acceleration * 1.01
    assert np.abs(rate[:, 1]).max() <= _LIMITS.omega_acceleration * 1.01


def test_arcs_in_a_row_end_where_each_ends_after_the_other() -> None:
    """The poses of many arcs at once are those of one after the other."""
    random = np.random.default_rng(3)
    forward, turn, length = random.uniform(-1, 1, 50), random.uniform(-2, 2, 50), random.uniform(0.1, 2, 50)
    pose = np.array([1.0, -2.0, 0.5])
    found = chained(pose, forward, turn, length)
    assert np.array_equal(found[0], pose)
    for i in range(50):
        pose = integrate_pose(pose, forward[i], turn[i], length[i])
        assert found[i + 1] == pytest.approx(pose, abs=1e-12)


@pytest.mark.parametrize(
    "segments",
    [
        [Segment(v=0.4, omega=0.1, duration=1e9)],
        [Segment(v=0.0, omega=0.1, duration=1e9)],
        # A long segment among short ones, which the joints beside it would not show.
        [
            Segment(v=0.5, omega=-0.5, duration=0.003),
            Segment(v=-0.5, omega=0.001, duration=1e6),
            Segment(v=0.5, omega=0.8, duration=3.0),
        ],
    ],
)
def test_a_path_that_would_be_cut_into_too_many_pieces_is_refused_before(segments: list[Segment]) -> None:
    """The first would take 149 GiB."""
    tracemalloc.start()
    with pytest.raises(ConfigError, match=r"^here: it is so long that it is cut into .* pieces"):
        lay_smooth(segments, _LIMITS, name="x", where="here")
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_too_many_points_segments_and_joints_are_refused_with_their_number() -> None:
    """Each before any work is done on it."""
    settings = load_settings()
    with pytest.raises(ConfigError, match=r"here: 50,001 points, at most 50,000"):
        lay_waypoints(_wave(50_001), _LIMITS, name="x", where="here")
    rows = np.zeros((settings.max_pieces // settings.least_pieces_per_row + 1, 4))
    rows[:, 0] = np.arange(len(rows))
    with pytest.raises(ConfigError, match=r"here: 500,001 points"):
        lay_timed_poses(rows, _LIMITS, name="x", where="here")
    one = Segment(v=0.1, omega=0.0, duration=1.0)
    with pytest.raises(ConfigError, match=r"here: 100,001 segments"):
        lay_segments([one] * (settings.most_segments + 1), _LIMITS, name="x", where="here")
    bent = [Segment(v=0.2, omega=1e-5 * i, duration=1.0) for i in range(settings.most_joints + 2)]
    with pytest.raises(ConfigError, match=r"here: 5,001 different joints"):
        lay_smooth(bent, _LIMITS, name="x", where="here")


def test_a_file_of_poses_is_left_as_soon_as_it_is_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the memory of the rows that may be, not of those that are there."""
    fewer = load_settings().model_copy(update={"max_pieces": 2000})
    monkeypatch.setattr("diffdrive_mpc.mpc.trajectories.timed_poses.load_settings", lambda: fewer)
    file = tmp_path / "long.csv"
    file.write_text("t,x,y,theta\n" + "".join(f"{i},0,0,0\n" for i in range(200_000)), encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(ConfigError, match="more than 1,000 timed poses"):
        load_trajectory(file)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_waypoints_that_are_as_good_as_one_are_named() -> None:
    """A chord so short that its square is nothing."""
    with pytest.raises(ConfigError, match=r"waypoints.0 and waypoints.1 coincide"):
        lay_waypoints([(0.0, 0.0), (1e-300, 0.0), (1.0, 0.0)], _LIMITS, name="x")


def test_a_drive_that_is_searched_for_has_a_longest_time() -> None:
    """A thousand million seconds of twists would be looked for, one by one."""
    with pytest.raises(ValueError, match="at most 1800 s"):
        slip_excitation(6.0, 1e9, 0.6, 1.0)


def test_a_way_of_two_millimetres_is_driven_from_rest_to_rest() -> None:
    """It is one piece long: without a node between it would never move."""
    path = lay_smooth([Segment(v=1.0, omega=0.0, duration=0.002)], _LIMITS, name="x")
    end = path.sample([path.duration]).pose[0]
    assert end == pytest.approx([0.002, 0.0, 0.0], abs=1e-9)
    assert 0.0 < path.duration < 1.0


@pytest.mark.parametrize("row", ["1e308,0,0,0", "1,1e308,0,0", "1,0,-1e308,0", "1,0,0,1e300"])
def test_poses_further_than_any_robot_goes_are_refused_by_their_line(tmp_path: Path, row: str) -> None:
    """They used to overflow in the spline, with a warning of NumPy's and a sentence of SciPy's."""
    file = tmp_path / "far.csv"
    file.write_text(f"t,x,y,theta\n0,0,0,0\n{row}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"far.csv, line 3: .* is beyond"):
        load_trajectory(file)
