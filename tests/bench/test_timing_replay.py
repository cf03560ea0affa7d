"""The timing pass replays a run exactly, or says that it cannot."""

from __future__ import annotations

import gc
import os
from dataclasses import replace

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle, quick_outcome

from bench.errors import NotReproducibleError
from bench.peers.kanayama import KanayamaController, KanayamaStep
from bench.runner import run_cases, time_outcomes
from bench.timing import quiet_core, replay
from models.interface import Measurement
from sim import simulate


class Moody(KanayamaController):
    """Remembers something that `start` does not reset."""

    calls = 0

    def step(self, t: float, measurement: Measurement) -> KanayamaStep:
        Moody.calls += 1
        step = super().step(t, measurement)
        return replace(step, command=step.command + 1e-15 * Moody.calls)


def test_a_replay_times_every_tick() -> None:
    run = simulate(KanayamaController(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    times = replay(KanayamaController(), run, len(run.time))
    assert times.shape == run.time.shape
    assert (times > 0).all()


def test_a_difference_in_the_last_bit_is_found() -> None:
    run = simulate(KanayamaController(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    command = run.command.copy()
    command[77, 1] = np.nextafter(command[77, 1], 1.0)
    with pytest.raises(NotReproducibleError, match=r"arc, t = 1\.555 s"):
        replay(KanayamaController(), replace(run, command=command), len(run.time))


def test_a_controller_with_hidden_state_is_found_out() -> None:
    run = simulate(Moody(), DisplacedUnicycle([0.0, 0.1, 0.0]), Arc())
    with pytest.raises(NotReproducibleError, match="not deterministic"):
        replay(Moody(), run, len(run.time))


def test_the_predictive_controller_replays_bit_for_bit() -> None:
    outcome = quick_outcome(sensors="default", surface="default")
    (timed,), share = time_outcomes([outcome], lambda: None)
    assert timed.run.metrics.position_rmse_m == outcome.run.metrics.position_rmse_m
    assert timed.run.metrics.step_time_max_s > 0
    assert share > 0


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


def test_runs_do_not_depend_on_the_number_of_processes() -> None:
    cases = [quick_outcome(controller="kanayama", model="none", trajectory=name).case for name in ("circle", "s")]
    done: list[int] = []
    alone = run_cases(cases, 1, lambda: done.append(1))
    together = run_cases(cases, 2, lambda: done.append(1))
    assert len(done) == 4
    for one, other in zip(alone, together, strict=True):
        assert one.case == other.case
        assert np.array_equal(one.run.true_pose, other.run.true_pose)
        assert np.array_equal(one.run.command, other.run.command)
