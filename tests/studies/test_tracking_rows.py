"""Runs reduced to rows, and errors split into what repeats and what does not."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from bench_parts import Arc, DisplacedUnicycle
from hypothesis import given
from hypothesis import strategies as st
from tracking_parts import case, recovery, row

from diffdrive_mpc.bench.experiment import frame, json_rows
from diffdrive_mpc.bench.peers.kanayama import KanayamaController
from diffdrive_mpc.sim import simulate
from studies.tracking.measured import decompose, measured


@pytest.fixture(scope="module")
def run():
    """Starts 0.2 m to the left of an arc and comes back."""
    return simulate(KanayamaController(), DisplacedUnicycle([0.0, 0.2, 0.0]), Arc(duration=8.0))


def test_along_and_across_are_the_position_error_in_the_frame_of_the_reference(run):
    kept = measured(case(surface="slippery"), run)
    assert np.hypot(kept["along"], kept["across"]) == pytest.approx(run.errors.position[run.counted])
    assert (kept["along"][0], kept["across"][0]) == pytest.approx((0.0, 0.2))
    assert len(kept["time"]) == run.metrics.steps


def test_a_row_keeps_the_arcs_and_the_lateral_error_after_the_start(run):
    kept = measured(case(surface="slippery"), run)
    late = np.abs(run.errors.lateral[run.counted & (run.time >= 2.0)]).max()
    assert kept["late_lateral_m"] == pytest.approx(late)
    assert late < 0.5 * run.metrics.lateral_max_m
    assert kept["arcs"] == pytest.approx([run.errors.lateral[run.counted][kept["steady"]].mean()])


def test_a_row_is_plain_json_without_series_and_step_times():
    (values,) = json_rows(frame([row(case(overrides=(("horizon", 12),)), **recovery(), late_lateral_m=0.0012345678)]))
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["recovery_time_s"] is None
    assert values["late_lateral_m"] == 0.00123457
    assert values["set"] == {"horizon": 12}
    assert not [name for name in values if "step_time" in name or name in ("across", "case")]


def test_a_repeated_error_is_bias_in_the_arc_and_transient_outside_and_noise_is_neither():
    wave = 0.002 * (-1.0) ** np.arange(100)
    steady = np.arange(100) >= 50
    bias, entry = np.where(steady, 0.003, 0.0), np.where(steady, 0.0, 0.005)
    rows = [row(case(seed=seed), across=bias + entry + sign * wave) for seed, sign in ((20, 1), (21, -1))]
    parts = decompose(frame(rows))
    # The variance of two opposite values, estimated without bias, is twice their square.
    assert parts.noise == pytest.approx(2 * 0.002**2)
    assert parts.bias == pytest.approx(0.5 * (0.003**2 - 0.002**2))
    assert parts.transient == pytest.approx(0.5 * (0.005**2 - 0.002**2))
    assert parts.along == 0.0


@given(st.integers(1, 6), st.integers(0, 1000))
def test_the_parts_add_up_to_the_mean_square_whatever_the_errors(seeds, key):
    random = np.random.default_rng(key)
    rows = [row(case(seed=k), across=random.normal(size=100), along=random.normal(size=100)) for k in range(seeds)]
    total = np.mean([one["across"] ** 2 + one["along"] ** 2 for one in rows])
    assert decompose(frame(rows)).total == pytest.approx(total)


def test_pure_noise_leaves_little_that_repeats():
    random = np.random.default_rng(1)
    rows = [row(case(seed=k), across=0.003 * random.normal(size=100)) for k in range(200)]
    parts = decompose(frame(rows))
    assert parts.noise == pytest.approx(0.003**2, rel=0.05)
    assert abs(parts.bias + parts.transient) < 0.01 * parts.noise


def test_a_single_run_has_no_noise_to_see():
    parts = decompose(frame([row(case(), across=np.full(100, 0.004))]))
    assert parts.noise == 0.0
    assert math.sqrt(parts.total) == pytest.approx(0.004)


def test_runs_of_different_length_are_refused():
    short = row(case(seed=21), time=0.02 * np.arange(90))
    with pytest.raises(ValueError, match="ticks cannot be compared"):
        decompose(frame([row(case()), short]))
