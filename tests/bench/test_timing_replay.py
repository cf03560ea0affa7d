"""The timing pass replays a run exactly, or says that it cannot; every outcome gets its own times."""

from __future__ import annotations

import gc
import os
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle, quick_outcome
from loop_parts import FeedForward, FixedStep

from diffdrive_mpc.bench.controllers import run_case
from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.bench.runner import NotReproducibleError, run_tasks
from diffdrive_mpc.bench.timing import quiet_core, replay, time_outcomes
from diffdrive_mpc.bench.turns import BLOCK, COLD, TurnTimes
from diffdrive_mpc.models.interface import FloatArray, Measurement, TrackingController
from diffdrive_mpc.sim import Run, simulate


class Moody(FeedForward):
    """Remembers something that `start` does not reset."""

    calls = 0

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        Moody.calls += 1
        step = super().step(t, measurement)
        return replace(step, command=step.command + 1e-15 * Moody.calls)


class Dawdling(FeedForward):
    """Takes 2 ms longer than it says: time outside its own clock."""

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        step = super().step(t, measurement)
        time.sleep(2e-3)
        return step


def replay_all(controller: TrackingController, run: Run) -> FloatArray:
    controller.start(run.reference, 0.0)
    return replay(controller, run, 0, len(run.time))


def test_a_replay_measures_every_whole_step_itself() -> None:
    run = simulate(FeedForward(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc(duration=1.0))
    controller = Dawdling()
    controller.start(run.reference, 0.0)
    times = replay(controller, run, 0, len(run.time))
    assert times.shape == (len(run.time), 2)
    assert (times[:, 0] >= 2e-3).all()
    assert np.isnan(times[:, 1]).all()




def test_every_outcome_gets_the_times_of_its_own_replay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Step times are the trajectory's duration plus the tick's own time, in whatever order the blocks are replayed."""
    outcomes = [quick_outcome(controller="kanayama", model="none", trajectory=name) for name in ("circle", "s")]

    def timed_by_tick(controller: object, run: Run, first: int, last: int) -> FloatArray:
        steps = run.reference.duration + run.time[first:last]
        return np.column_stack([steps, steps / 2])

    monkeypatch.setattr("diffdrive_mpc.bench.timing.replay", timed_by_tick)
    monkeypatch.setattr(Effort, "undisturbed", lambda self, best: True)
    timed, _ = time_outcomes(outcomes, lambda: None)
    for outcome, before in zip(timed, outcomes, strict=True):
        timed_ticks = np.arange(len(before.run.time)) % BLOCK >= COLD
        expected = np.where(timed_ticks, before.run.reference.duration + before.run.time, np.nan)
        assert np.array_equal(outcome.run.step_time, expected, equal_nan=True)
        assert np.array_equal(outcome.run.solve_time, expected / 2, equal_nan=True)
        assert outcome.clean_share == 1.0


@pytest.mark.parametrize("clean", [1, 0])
def test_disturbed_ticks_are_left_out_of_all_controllers_or_of_none(
    clean: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A peer's disturbed ticks must not stand beside times of others that have none."""
    outcomes = [quick_outcome(controller="kanayama", model="none"), quick_outcome()]
    times = []
    for outcome, undisturbed in zip(outcomes, (clean, 5), strict=True):
        ticks = len(outcome.run.time)
        times.append(TurnTimes(np.ones((1, ticks, 2)), np.arange(ticks)[None] < undisturbed))
    monkeypatch.setattr("diffdrive_mpc.bench.timing.take_turns", lambda *_, **__: ([times], 1e-5))
    timed, _ = time_outcomes(outcomes, lambda: None)
    kept = [int(np.isfinite(outcome.run.step_time).sum()) for outcome in timed]
    assert kept == ([1, 5] if clean else [len(outcome.run.time) for outcome in outcomes])


def test_a_difference_in_the_last_bit_is_found() -> None:
    run = simulate(FeedForward(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    command = run.command.copy()
    command[77, 1] = np.nextafter(command[77, 1], 1.0)
    with pytest.raises(NotReproducibleError, match=r"arc, t = 1\.555 s"):
        replay_all(FeedForward(), replace(run, command=command))


def test_a_controller_with_hidden_state_is_found_out() -> None:
    run = simulate(Moody(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    with pytest.raises(NotReproducibleError, match="not deterministic"):
        replay_all(Moody(), run)


def test_the_predictive_controller_replays_bit_for_bit() -> None:
    outcome = quick_outcome(sensors="default", surface="default")
    (timed,), timing = time_outcomes([outcome], lambda: None)
    assert timed.run.metrics.position_rmse_m == outcome.run.metrics.position_rmse_m
    assert 0 < timed.run.metrics.solve_time_max_s < timed.run.metrics.step_time_max_s
    assert timing.yardstick > 0
    assert 0 <= timing.clean_share == timed.clean_share <= 1


def test_the_quiet_core_is_given_back() -> None:
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    with pytest.raises(KeyError), quiet_core():
        assert not gc.isenabled()
        if cores is not None:
            assert len(os.sched_getaffinity(0)) == 1
        raise KeyError
    assert gc.isenabled()
    if cores is not None:
        assert os.sched_getaffinity(0) == cores


