"""Rates, tails and boundaries of a proof, held against what defines them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom

from diffdrive_mpc.app.proof.boundaries import Boundary, drawn_map, find_boundaries, map_runs
from diffdrive_mpc.app.proof.proof_file import BoundarySearch, Map, MapAxis
from diffdrive_mpc.app.proof.report import Outcomes, facts, is_unsafe, tables, worst
from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.engine import CampaignRun
from diffdrive_mpc.bench.campaign.rates import Rate
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.statistics import BootstrapEstimate, cvar, mean, median

PROBE = Definition(Case())
BAND = 0.05  # m


def driven(definition: Definition = PROBE, **row: object) -> CampaignRun:
    usual: dict[str, object] = {
        "completed": True,
        "error": "",
        "ended": "",
        "message": "",
        "last_mode": "FINISHED",
        "steps": 500,
        "position_rmse_m": 0.004,
        "lateral_max_m": 0.01,
        "time_processor_s": 1.0,
        **{f"unsafe_{kind}": 0 for kind in ("not_finite", "limit", "slew", "motion", "turn")},
    }
    return CampaignRun(definition, f"{definition.case.seed:064d}", usual | row)  # type: ignore[arg-type]


@pytest.mark.parametrize(("count", "of"), [(3, 40), (39, 40), (20, 40), (1, 300)])
def test_an_exact_interval_leaves_a_fortieth_on_each_side(count: int, of: int) -> None:
    rate = Rate.of_runs(count, of)
    assert binom.sf(count - 1, of, rate.low) == pytest.approx(0.025)
    assert binom.cdf(count, of, rate.high) == pytest.approx(0.025)
    assert binom.cdf(count, of, rate.bound) == pytest.approx(0.05)


def test_none_of_many_is_stated_as_what_it_is() -> None:
    rate = Rate.of_runs(0, 10_000)
    assert rate.low == rate.share == 0.0
    # If the share were the bound, none of 10,000 would be seen once in twenty.
    assert (1.0 - rate.bound) ** 10_000 == pytest.approx(0.05)
    assert 2.9e-4 < rate.bound < 3.0e-4
    assert Rate.of_runs(40, 40).high == 1.0


def test_the_tail_is_the_mean_of_the_worst_twentieth() -> None:
    values = np.random.default_rng(0).permutation(np.arange(1.0, 101.0))
    assert cvar(values) == pytest.approx(np.mean([96, 97, 98, 99, 100]))
    # A twentieth of 30 runs is one and a half of them.
    assert cvar(np.arange(1.0, 31.0)) == pytest.approx((30 + 0.5 * 29) / 1.5)
    assert cvar(np.arange(1.0, 11.0)) == 10.0
    assert cvar(np.arange(12.0).reshape(2, 6), axis=-1) == pytest.approx([5.0, 11.0])
    # Of a normal distribution it is density over tail: 2.0627 standard deviations.
    assert cvar(np.random.default_rng(1).normal(size=400_000)) == pytest.approx(2.0627, abs=0.02)


def test_a_bootstrap_interval_is_as_wide_as_theory_says() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, size=400)
    found = BootstrapEstimate.of_runs(values, mean)
    half = 1.96 * np.std(values) / math.sqrt(400)
    assert found.value == pytest.approx(np.mean(values))
    assert (found.low, found.high) == pytest.approx((found.value - half, found.value + half), abs=0.2 * half)
    assert BootstrapEstimate.of_runs(values, median).value == pytest.approx(np.median(values))
    assert BootstrapEstimate.of_runs(values, mean) == found


def test_few_runs_have_no_interval() -> None:
    assert math.isnan(BootstrapEstimate.of_runs([], mean).value)
    one = BootstrapEstimate.of_runs([3.0], cvar)
    assert (one.value, math.isnan(one.low)) == (3.0, True)
    assert BootstrapEstimate.of_runs([3.0, 3.0], cvar) == BootstrapEstimate(3.0, 3.0, 3.0)


class Robot:
    """Holds up to a threshold of each factor, with one seed a little less; counts its drives."""

    def __init__(self, downwards: bool = False, **limits: float) -> None:
        self._limits = {name.replace("__", "."): limit for name, limit in limits.items()}
        self._down = downwards
        self.rounds = 0

    def drive(self, runs: list[Definition]) -> list[CampaignRun]:
        self.rounds += 1
        found = []
        for run in reversed(runs):
            holds = True
            for name, limit in self._limits.items():
                value = run.factors.get(name)
                if isinstance(value, float):
                    shifted = limit - 0.01 * (run.case.seed == 2)
                    holds &= value >= limit if self._down else value <= shifted
            found.append(driven(run, lateral_max_m=0.02 if holds else 0.08))
        return found


def search(**fields: float) -> BoundarySearch:
    return BoundarySearch(**fields)  # type: ignore[arg-type]


def test_bisection_closes_in_on_where_every_seed_holds() -> None:
    robot = Robot(robot__robot__mass=17.3, sensors__pose__latency=0.2)
    asked = {
        "robot.robot.mass": search(holds=5.0, beyond=37.0, within=0.5),
        "sensors.pose.latency": search(holds=0.0, beyond=0.5, within=0.02),
    }
    mass, latency = find_boundaries(asked, PROBE, (1, 2), robot.drive, BAND)
    assert mass.held is not None
    assert mass.failed is not None
    assert mass.held <= 17.29 < mass.failed
    assert mass.failed - mass.held <= 0.5
    # The seed that holds less decides.
    assert latency.held is not None
    assert latency.failed is not None
    assert latency.held <= 0.19 < latency.failed
    # 32 kg to 0.5 kg are six halvings after the two ends; both factors were searched in the same rounds.
    assert (len(mass.values), robot.rounds) == (8, 8)


def test_a_boundary_may_lie_below() -> None:
    robot = Robot(downwards=True, surface__friction=0.23)
    (found,) = find_boundaries(
        {"surface.friction": search(holds=0.8, beyond=0.0, within=0.05)}, PROBE, (1,), robot.drive, BAND
    )
    assert found.held is not None
    assert found.failed is not None
    assert found.failed < 0.23 <= found.held
    assert found.held - found.failed <= 0.05


def test_what_never_or_always_holds_is_said_after_one_look_at_each_end() -> None:
    asked = {"surface.friction": search(holds=0.8, beyond=2.0, within=0.05)}
    (never,) = find_boundaries(asked, PROBE, (1,), Robot(surface__friction=0.1).drive, BAND)
    assert (never.held, never.failed, list(never.values)) == (None, 0.8, [0.8])
    (always,) = find_boundaries(asked, PROBE, (1,), Robot(surface__friction=9.0).drive, BAND)
    assert (always.held, always.failed, list(always.values)) == (2.0, None, [0.8, 2.0])


def test_a_run_that_does_not_end_does_not_hold() -> None:
    boundary = Boundary("x", search(holds=0.0, beyond=1.0, within=0.1))
    assert boundary.next_value == 0.0
    (found,) = find_boundaries(
        {"surface.friction": search(holds=0.8, beyond=0.1, within=0.5)},
        PROBE,
        (1,),
        lambda runs: [driven(run, completed=False) for run in runs],
        BAND,
    )
    assert found.held is None


def test_a_map_has_its_first_factor_along_x() -> None:
    of = Map(
        x=MapAxis(factor="robot.robot.mass", low=5.0, high=7.0, steps=3),
        y=MapAxis(factor="surface.friction", low=0.2, high=0.4, steps=2),
    )
    runs = map_runs(of, PROBE, 3)
    found = drawn_map(
        "m", of, runs, [driven(run, position_rmse_m=dict(run.robot)["robot.mass"]) for run in reversed(runs)]
    )
    assert found.error.tolist() == [[5.0, 6.0, 7.0]] * 2
    assert {dict(run.surface)["friction"] for run in runs[:3]} == {0.2}
    assert {run.case.seed for run in runs} == {3}


def test_unsafe_runs_are_counted_and_come_first_among_the_worst() -> None:
    runs = [driven(PROBE.with_seed(seed)) for seed in range(20)]
    runs[4] = driven(PROBE.with_seed(4), unsafe_slew=3)
    runs[9] = driven(PROBE.with_seed(9), completed=False, position_rmse_m=0.5, lateral_max_m=0.4)
    runs[7] = driven(PROBE.with_seed(7), completed=False, position_rmse_m=2.0, last_mode="STOPPED")
    runs[2] = driven(PROBE.with_seed(2), completed=False, error="ValueError: x", position_rmse_m=None)
    assert [one.definition.case.seed for one in worst(runs, 3)] == [4, 2, 9]
    assert worst(runs, 20)[-1] is runs[7]
    assert [is_unsafe(one) for one in runs].index(True) == 4
    of = Outcomes.of(runs, BAND)
    assert (of.unsafe.count, of.completed.count, of.stopped.count, of.in_band.count) == (1, 17, 1, 17)
    said = "\n".join(facts(runs, 5))
    assert "1 of 20 runs had an unsafe command: with 95 % confidence fewer than 21.6 %" in said
    assert "1 runs ended in an error" in said
    unsafe = next(table for table in tables(runs, [], {}, 3, BAND) if table.title == "Unsafe commands")
    assert {row[0]: row[1:3] for row in unsafe.rows}["beyond the slew or the braking limit"] == ("3", "1 of 20")


def test_a_search_that_can_find_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no further apart than within"):
        search(holds=0.1, beyond=0.15, within=0.1)
