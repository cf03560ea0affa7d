"""Objective, front and paired intervals, held against what defines them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffdrive_mpc.app.tune.objective import broken, exceeded, in_words, score, terms_of
from diffdrive_mpc.app.tune.search import Searched, TunePoint
from diffdrive_mpc.app.tune.tune_file import Constraint, Objective
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.engine import CampaignRun
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.statistics import BootstrapEstimate
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray

TERMS = terms_of(
    Objective(
        error={"position_rmse_m": {"mean": 2.0, "cvar": 1.0}},
        effort={"recovery_command_rate_v": {"mean": 0.5}, "recovery_command_energy_v": {"mean": 0.5}},
    )
)
TABLES = st.lists(
    st.lists(st.floats(0.01, 100.0), min_size=12, max_size=12), min_size=len(TERMS), max_size=len(TERMS)
).map(np.array)


def driven(**row: object) -> CampaignRun:
    usual = {"completed": True, "error": "", "position_rmse_m": 0.01, "unsafe_limit": 0}
    usual |= {"recovery_command_rate_v": 1.0, "recovery_command_energy_v": 1.0}
    return CampaignRun(Definition(Case()), "0" * 64, usual | row)  # type: ignore[arg-type]


@given(TABLES, TABLES, st.floats(0.1, 10.0))
def test_the_objective_is_a_weighted_ratio(mine: FloatArray, usual: FloatArray, factor: float) -> None:
    assert float(score(TERMS, usual, usual).value) == pytest.approx(1.0)
    found = score(TERMS, mine, usual)
    assert float(found.value) == pytest.approx(0.75 * float(found.error) + 0.25 * float(found.effort))
    # The unit of a column is of no account, and all figures are homogeneous.
    units = np.linspace(0.5, 20.0, len(TERMS))[:, None]
    assert float(score(TERMS, units * mine, units * usual).value) == pytest.approx(float(found.value))
    assert float(score(TERMS, factor * mine, usual).value) == pytest.approx(factor * float(found.value))


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(1, 6), st.booleans()), min_size=1, max_size=12))
def test_no_usable_point_beats_one_of_the_front(listed: list[tuple[int, int, bool]]) -> None:
    points = [TunePoint(k, {}, 1, 1.0, e, f, 1.0, "", usable=u) for k, (e, f, u) in enumerate(listed)]
    found = Searched(points, {})

    def beats(a: TunePoint, b: TunePoint) -> bool:
        return a.error <= b.error and a.effort <= b.effort and (a.error, a.effort) != (b.error, b.effort)

    for one in found.front:
        assert not any(beats(other, one) for other in found.usable)
    for one in found.usable:
        assert any((a.error, a.effort) == (one.error, one.effort) or beats(a, one) for a in found.front)


def test_what_has_to_hold_is_counted() -> None:
    good, bad = driven(), driven(unsafe_slew=3)
    assert in_words(broken([good, good], [good, good], TERMS)) == ""
    assert in_words(broken([good, bad], [good, good], TERMS)) == "unsafe"
    assert in_words(broken([driven(completed=False), good], [good, good], TERMS)) == "not completed"
    assert in_words(broken([driven(completed=False), good], [driven(completed=False), good], TERMS)) == ""
    assert in_words(broken([driven(position_rmse_m=None), good], [good, good], TERMS)) == "not driven"


def test_a_constraint_counts_the_worst_run_that_has_the_column() -> None:
    usual = [driven(recovery_overshoot_m=0.02), driven(recovery_overshoot_m=None)]
    fixed = Constraint(column="recovery_overshoot_m", at_most=0.04)
    times = Constraint(column="recovery_overshoot_m", times=1.5)
    mine = [driven(recovery_overshoot_m=0.01), driven(recovery_overshoot_m=0.035)]
    assert exceeded(fixed, mine, usual, "overshoot") == pytest.approx(-1.0 / 8.0)
    assert exceeded(times, mine, usual, "overshoot") == pytest.approx(1.0 / 6.0)
    with pytest.raises(ConfigError, match="an overshoot needs a scenario"):
        exceeded(fixed, mine, [driven()], "overshoot")


def test_what_two_share_run_by_run_does_not_widen_their_interval() -> None:
    rng = np.random.default_rng(3)
    shared = rng.uniform(1.0, 9.0, 40)
    usual = np.array([shared])
    mine = np.array([0.8 * shared + rng.normal(0.0, 0.01, 40)])

    def ratio(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(a.mean(axis=-1) / b.mean(axis=-1))[0]

    found = BootstrapEstimate.of_same_runs((mine, usual), ratio)
    assert found.low < 0.8 < found.high
    assert found.high - found.low < 0.01
    assert BootstrapEstimate.of_same_runs((usual, usual), ratio) == BootstrapEstimate(1.0, 1.0, 1.0)
