"""The experiments of `reproduce`: kinematics, drives, lines and what is taken from the papers."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from diffdrive_mpc import integrate_pose, load_trajectory
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.robot import load_robot
from studies.reproduce.cost import measure_cost
from studies.reproduce.drive_models import (
    EXPERIMENTAL,
    NO_MODEL,
    PHYSICAL,
    compare_on_twin,
    drive_model_findings,
    drive_model_tables,
    reversing_commands,
    velocity_errors,
)
from studies.reproduce.drives import (
    RobotLogs,
    Spread,
    dead_reckon,
    pose_error,
    trajectory_commands,
)
from studies.reproduce.mbm_and_sm import COMPARED, DATA, MBM, MBM_TRACKS, compare_mbm_and_sm
from studies.reproduce.published import CostStudy, MbmSmStudy, SsmStudy, load_published, load_study
from studies.reproduce.state_space import IDENTIFIED, PRINTED, compare_orders
from studies.reproduce.study import ReproduceStudy
from studies.reproduce.virtual_track import (
    DrivenTrack,
    check_virtual_track,
    drive_tests,
    driven_track_findings,
    fit_line,
)

DT = load_robot().sample_time
twists = arrays(float, st.tuples(st.integers(2, 30), st.just(2)), elements=st.floats(-2.0, 2.0))


@given(twists)
def test_dead_reckoning_goes_arc_by_arc(twist):
    pose = np.array([0.3, -0.2, 2.0])
    one_by_one = [pose]
    for before, after in pairwise(twist):
        one_by_one.append(integrate_pose(one_by_one[-1], *(0.5 * (before + after)), DT))
    assert dead_reckon(twist, pose, DT) == pytest.approx(np.array(one_by_one), abs=1e-12)


@given(arrays(float, st.integers(1, 40), elements=st.floats(-10.0, 10.0)))
def test_statistics_of_an_error_agree_with_each_other(error):
    found = Spread.of(error)
    assert found.rmse**2 == pytest.approx(found.mean**2 + found.std**2, abs=1e-9)
    assert found.mean <= found.rmse + 1e-9
    assert found.rmse <= found.max + 1e-9


def test_an_error_counts_in_place_and_in_heading():
    driven = np.zeros((2, 3))
    predicted = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, -0.2]])
    error = pose_error(predicted, driven)
    assert (error.position.max, error.heading.max) == (5.0, 0.2)


@pytest.mark.parametrize("name", ["circle", "square", "s", "cane"])
def test_open_loop_commands_trace_the_reference(name):
    """A robot that obeyed at once would end where the reference ends, but for the part of a sample at each jump."""
    commands = trajectory_commands(name)
    pose = np.zeros(3)
    for v, omega in commands:
        pose = integrate_pose(pose, v, omega, DT)
    reference = load_trajectory(name)
    assert pose == pytest.approx(reference.sample([reference.duration]).pose[0], abs=0.05)


def test_every_drive_has_noise_of_its_own_and_every_repetition_repeats():
    one, other = RobotLogs(31), RobotLogs(31)
    first, second = one.free(2, 2.0)
    again = other.free(1, 2.0)[0]
    assert np.array_equal(first.yaw_rate, again.yaw_rate)
    assert np.array_equal(first.pose, again.pose)
    assert not np.array_equal(first.command, second.command)
    steps = one.steps("v")
    assert np.array_equal(steps[0].command[0], steps[1].command[0])
    assert not np.array_equal(steps[0].yaw_rate[:20], steps[1].yaw_rate[:20])


def test_the_printed_tests_contradict_the_printed_line():
    """The slope has the wrong sign; four tracks exchanged, it is the printed one."""
    found = check_virtual_track(load_published().virtual_track, certain=2.0)
    assert (found.fitted.p1, found.fitted.p0) == pytest.approx((-0.022, 0.337), abs=5e-4)
    assert (found.fitted_exchanged.p1, found.fitted_exchanged.p0) == pytest.approx((0.054, 0.283), abs=5e-4)
    assert sorted(found.tests[:, 1]) == sorted(found.exchanged[:, 1])
    assert found.printed.misfit(found.exchanged) < 0.2 * found.printed.misfit(found.tests)


def test_whether_an_exchange_explains_the_printed_line_is_open():
    """Many other double exchanges fit too, and the printed radii side with the rows as they are printed."""
    found = check_virtual_track(load_published().virtual_track, certain=2.0)
    assert found.by_radius == pytest.approx(0.39, abs=5e-3)
    assert found.by_radius_exchanged == pytest.approx(-0.07, abs=5e-3)
    assert (found.fitting, found.exchanges) == (52, 210)


def test_drives_as_fast_as_the_papers_reach_its_range_and_do_not_leave_it():
    (drive,) = RobotLogs(31).free(1, 60.0, SMALL.paper_range)
    v, omega = np.abs(drive.command).max(axis=0)
    assert 1.2 < v <= 1.5
    assert 1.6 < omega <= 2.0


def test_a_line_is_found_whatever_the_sign_of_the_yaw_rate():
    rates = np.array([-1.0, 0.3, -0.5, 0.9])
    line = fit_line(np.column_stack([rates, 0.05 * np.abs(rates) + 0.3]))
    assert (line.p1, line.p0) == pytest.approx((0.05, 0.3))
    assert line.misfit(np.column_stack([np.abs(rates), 0.05 * np.abs(rates) + 0.3])) < 1e-12


def test_the_papers_statistics_are_copied_without_slips():
    """In every printed set RMSE, mean and standard deviation belong together, and averages are those of the rows."""
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


def test_a_larger_model_holds_more():
    done = []
    study = CostStudy(runs=2, steps=400, simulation_steps={"mbm": 20, "sm": 20, "ssm": 20, "lstm": 20})
    found = measure_cost(study, lambda: done.append(1))
    assert len(done) == 2 * study.runs
    assert found["mbm"].memory[0] > found["sm"].memory[0]
    assert all(one.time_per_step[0] > 0 and one.simulation_time[0] > 0 for one in found.values())


class CountingBar(ProgressBar):
    def __init__(self):
        super().__init__("test")
        self.done, self.total = 0, None

    def begin(self, text, total):
        self.total = total

    def advance(self):
        self.done += 1


SMALL = SsmStudy(
    train_duration=12.0,  # in 8 s the faster pole of some drives is not seen
    largest_order=2,
    test_drives=1,
    free_drives=1,
    free_duration=6.0,
    paper_range={"v": 1.5, "omega": 2.0},
)


@pytest.mark.long
def test_results_depend_on_the_repetition():
    """A fit beside drives, and the same fit alone; what another repetition is fitted to."""
    track = load_study(quick=True).driven_track.model_copy(update={"duration": 1.5, "settling": 0.5})
    study = load_study(quick=True).model_copy(update={"ssm": SMALL, "driven_track": track})
    whole = ReproduceStudy(study, ["ssm", "virtual_track"])
    bar = CountingBar()
    found = whole.run(whole.plan(), 1, bar)
    assert bar.done == bar.total == 2
    (result,) = found.ssm
    assert plain(result) == plain(compare_orders(SMALL, result.repetition))
    assert plain(found.driven_track[0]) == plain(drive_tests(track, "default"))
    assert set(result.free_drives) == set(result.full_range) == {IDENTIFIED, PRINTED}
    assert result.orders[1].train.fit_percent[1] > result.orders[0].train.fit_percent[1]
    own, other = (RobotLogs(repetition).free(1, 2.0)[0] for repetition in (result.repetition, result.repetition + 1))
    assert not np.array_equal(own.command, other.command)
    assert not np.array_equal(own.yaw_rate[:20], other.yaw_rate[:20])


@pytest.mark.long
def test_both_tracks_alone_tell_the_two_mbm_apart():
    """Where the robot is told to go straight, wheels differ only as motors do, and the track out of them counts.

    Told to turn, it is the ratio of the track into the motors to the one out of them: one for the robot's own track.
    """
    study = MbmSmStudy(trajectories=("cane",), free_drives=1, free_duration=6.0)
    found = compare_mbm_and_sm(study, 31)
    paths, tracks = found.paths["cane"], found.parameters[MBM]
    straight = slice(0, round(4.0 / DT))
    out = load_robot().track / tracks["effective_track"]
    assert np.abs(paths[MBM][straight, 2]).max() > 1e-4
    assert paths[MBM_TRACKS][straight, 2] == pytest.approx(out * paths[MBM][straight, 2], abs=1e-9)
    turned = {model: paths[model][-1, 2] - paths[model][straight.stop, 2] for model in (MBM, MBM_TRACKS)}
    ratio = tracks["firmware_track"] / tracks["effective_track"]
    assert turned[MBM_TRACKS] == pytest.approx(ratio * turned[MBM], rel=1e-3)
    for model in COMPARED:
        assert np.array_equal(paths[model][0], paths["driven"][0])
        assert found.errors[model]["cane"] == pose_error(paths[model], paths["driven"])
    for data in DATA:
        assert len(found.motor_fit[data]) == 4
        assert max(found.motor_fit[data]) < 100
    assert found.motor_fit[DATA[0]] != found.motor_fit[DATA[1]]


STUDY = load_study(quick=True).driven_track
FEW = STUDY.model_copy(
    update={"tests": ((0.3, 0.3), (0.35, 0.6), (0.4, 1.0)), "yaw_rates": (0.4, 0.8, 1.2), "speeds": (0.2, 0.5, 0.8)}
)


@pytest.fixture(scope="module")
def floors() -> list[DrivenTrack]:
    return [drive_tests(FEW, surface) for surface in ("default", "slippery")]


def test_friction_and_wheel_base_give_the_track_on_the_spot(floors):
    """Coulomb friction under four wheels: track (1 + (wheel base / track)^2), on any floor, at any yaw rate."""
    for floor in floors:
        (spot, *_) = floor.alone.values()
        assert spot[:, 2] == pytest.approx(0.33 * (1 + (0.14 / 0.33) ** 2), rel=0.02)


def test_less_friction_makes_the_centripetal_force_matter_more(floors):
    default, slippery = (floor.by_acceleration for floor in floors)
    assert slippery.p1 < 3 * default.p1 < 0


def test_a_track_that_grows_is_seen_to_grow():
    yaw = np.linspace(0.3, 1.0, 8)
    rows = np.column_stack([0.3 * np.ones(8), yaw, 0.286 + 0.049 * yaw + 1e-4 * (-1) ** np.arange(8), np.ones(8)])
    made = DrivenTrack("made", rows, {}, fit_line(rows[:, 1:3]))
    made = DrivenTrack("made", rows, dict.fromkeys(("turning on the spot, over yaw rate", "b"), rows), made.line)
    made.alone["at constant yaw rate, over v"] = rows[:, [1, 0, 2, 3]]
    grows, alone, spot = driven_track_findings([made], load_published())
    assert (grows.verdict, alone.verdict, spot.verdict) == ("yes", "no", "yes")
    assert made.line.p1 == pytest.approx(0.049, rel=0.01)


def test_commands_go_both_ways_as_fast_as_stated():
    study = load_study().drive_models
    commands = np.vstack([reversing_commands(study, seed, smooth=False) for seed in range(20)])
    assert np.abs(commands).max(axis=0) == pytest.approx([0.6, 1.1], rel=0.02)
    assert np.abs(np.mean(commands > 0, axis=0) - 0.5).max() < 0.1


def test_errors_count_where_there_are_readings_and_in_the_paper_s_units():
    fresh = np.arange(60) % 2 == 0
    twist = np.where(fresh[:, None], 0.2, 9.0) * np.ones((60, 2))
    twist[1::2] = np.nan
    record = Record("made", 0.0, 0.05, np.zeros((60, 2)), twist=twist, yaw_rate=np.full(60, 0.1))
    errors = velocity_errors([np.zeros((60, 2))], [record])
    assert errors.v == pytest.approx((200.0, 200.0))
    assert errors.omega == pytest.approx((np.degrees(0.1), np.degrees(0.1)))


@pytest.mark.long
def test_both_drive_models_beat_no_model_on_a_short_drive():
    study = load_study(quick=True).drive_models.model_copy(update={"drives": 2, "duration": 15.0})
    result = compare_on_twin(study, 77)
    for name in (PHYSICAL, EXPERIMENTAL):
        assert result.errors[name].v[0] < 0.5 * result.errors[NO_MODEL].v[0]
        assert result.errors[name].omega[0] < result.errors[NO_MODEL].omega[0]
    errors, numbers = drive_model_tables([result], load_published())
    assert {cells[0] for cells in errors.rows} == {"P2, first data set", "P2, second data set", "simulated robot"}
    assert len(numbers.rows) == 2
    assert drive_model_findings([result], load_published())[0].verdict == "yes"
