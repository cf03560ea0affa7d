"""What the statistics cover and what counts as a completed run."""

from __future__ import annotations

import numpy as np
import pytest
from loop_parts import ConstantTwist, FeedForward, KinematicPlant, Slow, run_along

from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.metrics import FALLBACK_MODES, GIVEN_UP_MODES

LINE = ConstantTwist(v=0.5, omega=0.0, duration=1.0)
TIMES = np.arange(0, 51) * 0.02


def test_ticks_after_the_end_of_the_reference_are_not_counted() -> None:
    controller = FeedForward({80: "BRAKING"})
    run = simulate(controller, KinematicPlant(), LINE, extra_time=1.0)
    assert len(run.time) == 101
    assert run.metrics.steps == 51
    assert run.metrics.fallbacks == 0
    assert run.metrics.completed


def test_fallback_ticks_are_counted_by_mode() -> None:
    modes = {3: "REUSED_PLAN", 4: "BRAKING", 5: "STOPPED", 50: "FINISHED"}
    run = simulate(FeedForward(modes), KinematicPlant(), LINE)
    assert run.metrics.fallbacks == 3
    assert run.metrics.completed


def test_every_mode_of_the_controller_is_a_fallback_or_known_to_be_none() -> None:
    assert FALLBACK_MODES | {"TRACKING", "FINISHED"} == {mode.value for mode in Mode}
    assert not FALLBACK_MODES & {"TRACKING", "FINISHED"}
    assert GIVEN_UP_MODES < FALLBACK_MODES


@pytest.mark.parametrize("mode", ["BRAKING", "STOPPED"])
def test_a_run_that_ends_without_tracking_is_not_completed(mode: str) -> None:
    assert not simulate(FeedForward({50: mode}), KinematicPlant(), LINE).metrics.completed


def test_a_run_that_ends_elsewhere_is_not_completed() -> None:
    pose = LINE.sample(TIMES).pose
    assert run_along(LINE, pose + np.array([0.2, 0.0, 0.0]), [0.5, 0.0, 0.0], TIMES).metrics.completed
    assert not run_along(LINE, pose + np.array([0.3, 0.0, 0.0]), [0.5, 0.0, 0.0], TIMES).metrics.completed


def test_a_run_cut_short_is_not_completed() -> None:
    pose = LINE.sample(TIMES[:40]).pose
    assert not run_along(LINE, pose, [0.5, 0.0, 0.0], TIMES[:40]).metrics.completed


def test_a_pose_that_is_not_finite_is_reported_and_not_averaged_away() -> None:
    pose = LINE.sample(TIMES).pose
    pose[20] = np.nan
    metrics = run_along(LINE, pose, [0.5, 0.0, 0.0], TIMES).metrics
    assert not metrics.completed
    assert np.isnan(metrics.position_rmse_m)
    assert metrics.in_band_percent == pytest.approx(100 * 50 / 51)


def test_a_step_longer_than_the_sample_is_a_missed_deadline() -> None:
    assert simulate(FeedForward(), KinematicPlant(), LINE).metrics.deadline_misses == 0
    slow = simulate(Slow(), KinematicPlant(), LINE).metrics
    assert slow.deadline_misses == slow.steps == 51
    assert slow.step_time_p99_s == pytest.approx(0.03)


def test_step_times_can_be_exchanged_for_those_of_a_timing_pass() -> None:
    run = simulate(Slow(), KinematicPlant(), LINE)
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
