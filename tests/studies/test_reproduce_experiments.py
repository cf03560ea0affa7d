"""Experiments of `reproduce`: kinematics, drives, lines, and values from the papers."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from diffdrive_mpc import integrate_pose, load_trajectory
from diffdrive_mpc.models.robot import load_robot
from studies.reproduce.drive_models import (
    EXPERIMENTAL,
    NO_MODEL,
    PHYSICAL,
    compare_on_twin,
    drive_model_findings,
    drive_model_tables,
)
from studies.reproduce.drives import RobotLogs, dead_reckon, trajectory_commands
from studies.reproduce.published import load_published, load_study
from studies.reproduce.virtual_track import DrivenTrack, drive_tests, fit_line

DT = load_robot().sample_time
twists = arrays(float, st.tuples(st.integers(2, 30), st.just(2)), elements=st.floats(-2.0, 2.0))


@given(twists)
def test_dead_reckoning_integrates_arcs(twist):
    pose = np.array([0.3, -0.2, 2.0])
    one_by_one = [pose]
    for before, after in pairwise(twist):
        one_by_one.append(integrate_pose(one_by_one[-1], *(0.5 * (before + after)), DT))
    assert dead_reckon(twist, pose, DT) == pytest.approx(np.array(one_by_one), abs=1e-12)


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_open_loop_commands_trace_the_reference(name):
    """A robot without lag ends where the reference ends, except for part of a sample at each jump."""
    commands = trajectory_commands(name)
    pose = np.zeros(3)
    for v, omega in commands:
        pose = integrate_pose(pose, v, omega, DT)
    reference = load_trajectory(name)
    assert pose == pytest.approx(reference.sample([reference.duration]).pose[0], abs=0.05)


def test_drives_have_different_noise_and_repetitions_are_reproducible():
    logs, repeated = RobotLogs(31), RobotLogs(31)
    first, second = logs.free(2, 2.0)
    again = repeated.free(1, 2.0)[0]
    assert np.array_equal(first.yaw_rate, again.yaw_rate)
    assert np.array_equal(first.pose, again.pose)
    assert not np.array_equal(first.command, second.command)
    steps = logs.steps("v")
    assert np.array_equal(steps[0].command[0], steps[1].command[0])
    assert not np.array_equal(steps[0].yaw_rate[:20], steps[1].yaw_rate[:20])


def test_line_is_fitted_for_any_sign_of_the_yaw_rate():
    rates = np.array([-1.0, 0.3, -0.5, 0.9])
    line = fit_line(np.column_stack([rates, 0.05 * np.abs(rates) + 0.3]))
    assert (line.p1, line.p0) == pytest.approx((0.05, 0.3))
    assert line.misfit(np.column_stack([np.abs(rates), 0.05 * np.abs(rates) + 0.3])) < 1e-12


def test_statistics_of_the_papers_are_consistent():
    """In every printed set RMSE, mean and standard deviation agree, and averages are those of the rows."""
    published = load_published()
    printed = [errors for rows in published.odometry.values() for errors in rows.values()]
    printed += [drive.odometry for drive in published.free_drives]
    for errors in printed:
        for rmse, mean, std, largest in (errors.position, errors.heading):
            assert rmse == pytest.approx(np.hypot(mean, std), abs=0.008)
            assert rmse < largest
    averages = {"mbm": (0.309, 0.170), "sm": (0.414, 0.239)}
    for model, (position, heading) in averages.items():
        rows = published.odometry[model].values()
        assert np.mean([row.position[0] for row in rows]) == pytest.approx(position, abs=0.0006)
        assert np.mean([row.heading[0] for row in rows]) == pytest.approx(heading, abs=0.0006)
    rows, average = published.free_drives, published.free_drives_average
    assert np.mean([row.values for row in rows], axis=0) == pytest.approx(average.values, abs=0.0051)
    for quantity in ("position", "heading"):
        means = np.mean([getattr(row.odometry, quantity) for row in rows], axis=0)
        assert means == pytest.approx(getattr(average.odometry, quantity), abs=0.0051)
    steps = load_study().cost.simulation_steps
    for name, cost in published.cost.items():
        assert cost.simulation_time[0] == pytest.approx(steps[name] * cost.time_per_step[0], rel=0.01)


STUDY = load_study(quick=True).driven_track
FEW = STUDY.model_copy(
    update={"tests": ((0.3, 0.3), (0.35, 0.6), (0.4, 1.0)), "yaw_rates": (0.4, 0.8, 1.2), "speeds": (0.2, 0.5, 0.8)}
)


@pytest.fixture(scope="module")
def driven_tracks() -> list[DrivenTrack]:
    return [drive_tests(FEW, surface) for surface in ("default", "slippery")]


def test_friction_and_wheel_base_give_the_track_of_a_turn_on_the_spot(driven_tracks):
    """Coulomb friction under four wheels: track (1 + (wheel base / track)^2), on any surface, at any yaw rate."""
    for driven in driven_tracks:
        (spot, *_) = driven.series.values()
        assert spot[:, 2] == pytest.approx(0.33 * (1 + (0.14 / 0.33) ** 2), rel=0.02)


@pytest.mark.long
def test_both_drive_models_are_better_than_no_model_on_a_short_drive():
    study = load_study(quick=True).drive_models.model_copy(update={"drives": 2, "duration": 15.0})
    result = compare_on_twin(study, 77)
    for name in (PHYSICAL, EXPERIMENTAL):
        assert result.errors[name].v[0] < 0.5 * result.errors[NO_MODEL].v[0]
        assert result.errors[name].omega[0] < result.errors[NO_MODEL].omega[0]
    errors, numbers = drive_model_tables([result], load_published())
    assert {cells[0] for cells in errors.rows} == {"P2, first data set", "P2, second data set", "simulated robot"}
    assert len(numbers.rows) == 2
    assert drive_model_findings([result], load_published())[0].verdict == "yes"
