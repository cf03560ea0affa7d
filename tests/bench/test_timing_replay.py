"""The timing pass replays a run exactly or raises an error; every outcome has separate times."""

import time
from dataclasses import replace

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle, quick_outcome
from loop_parts import FeedForward, FixedStep

from diffdrive_mpc.bench import turns
from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.bench.runner import NotReproducibleError
from diffdrive_mpc.bench.timing import replay, time_outcomes
from diffdrive_mpc.models.interface import FloatArray, Measurement, TrackingController
from diffdrive_mpc.sim import Run, simulate


class StatefulController(FeedForward):
    """Controller with a state that `start` does not reset."""

    calls = 0

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        StatefulController.calls += 1
        step = super().step(t, measurement)
        return replace(step, command=step.command + 1e-15 * StatefulController.calls)


class SlowController(FeedForward):
    """Controller that takes 2 ms longer than it reports."""

    def step(self, t: float, measurement: Measurement) -> FixedStep:
        step = super().step(t, measurement)
        time.sleep(2e-3)
        return step


def replay_all(controller: TrackingController, run: Run) -> FloatArray:
    controller.start(run.reference, 0.0)
    return replay(controller, run, 0, len(run.time))


def test_replay_measures_the_whole_step() -> None:
    run = simulate(FeedForward(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc(duration=1.0))
    controller = SlowController()
    controller.start(run.reference, 0.0)
    times = replay(controller, run, 0, len(run.time))
    assert times.shape == (len(run.time), 2)
    assert (times[:, 0] >= 2e-3).all()
    assert np.isnan(times[:, 1]).all()


def test_difference_in_the_last_bit_raises_error() -> None:
    run = simulate(FeedForward(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    command = run.command.copy()
    command[77, 1] = np.nextafter(command[77, 1], 1.0)
    with pytest.raises(NotReproducibleError, match=r"arc, t = 1\.555 s"):
        replay_all(FeedForward(), replace(run, command=command))


def test_controller_with_hidden_state_raises_error() -> None:
    run = simulate(StatefulController(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    with pytest.raises(NotReproducibleError, match="not deterministic"):
        replay_all(StatefulController(), run)


def test_mpc_is_replayed_bit_for_bit() -> None:
    outcome = quick_outcome(sensors="default", surface="default")
    (timed,), timing = time_outcomes([outcome], lambda: None)
    assert timed.run.metrics.position_rmse_m == outcome.run.metrics.position_rmse_m
    assert 0 < timed.run.metrics.solve_time_max_s < timed.run.metrics.step_time_max_s
    assert timing.yardstick > 0
    assert 0 <= timing.clean_share == timed.clean_share <= 1


UNDISTURBED = Effort(elapsed=1e-3, processor=1e-3, switches=0, pace=1e-5)


@pytest.fixture(autouse=True)
def frozen_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Freeze the clock, so that no retry times out on a busy machine."""
    monkeypatch.setattr(turns, "perf_counter", lambda: 0.0)


@pytest.mark.parametrize(
    ("changes", "undisturbed"),
    [
        ({}, True),
        ({"switches": 1}, False),
        ({"processor": 0.9e-3}, False),  # another process or the host used the core
        ({"processor": 0.985e-3}, True),  # reading clocks
        ({"pace": 1.2e-5}, False),  # a throttled or shared core
    ],
)
def test_block_is_disturbed_by_switches_lost_time_or_a_slow_pace(changes: dict[str, float], undisturbed: bool) -> None:
    assert UNDISTURBED._replace(**changes).is_undisturbed(best_pace=1e-5) is undisturbed
