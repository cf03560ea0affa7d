"""Rates, tails and boundaries of a proof, compared with their definitions."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.models.checked_yaml import ConfigError, read_yaml
from diffdrive_mpc_extras.bootstrap import BootstrapEstimate, cvar, mean, median
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.campaign.rates import Rate, conformal_quantile
from diffdrive_mpc_extras.proof.proof_file import DEFAULT as PROOF
from diffdrive_mpc_extras.proof.proof_file import Boundary, BoundarySearch, find_boundaries, load_proof
from diffdrive_mpc_extras.proof.report import Outcomes, facts, is_unsafe, tables, worst

PROBE = Definition(Case())
BAND = 0.05  # m


def make_run(definition: Definition = PROBE, **row: object) -> CampaignRun:
    defaults: dict[str, object] = {
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
    return CampaignRun(definition, f"{definition.case.seed:064d}", defaults | row)  # type: ignore[arg-type]


class Robot:
    """Robot that passes up to a threshold of each factor, slightly lower for seed 2; counts the rounds of drives."""

    def __init__(self, downwards: bool = False, **limits: float) -> None:
        self._limits = {name.replace("__", "."): limit for name, limit in limits.items()}
        self._down = downwards
        self.rounds = 0

    def drive(self, runs: list[Definition]) -> list[CampaignRun]:
        self.rounds += 1
        results = []
        for run in reversed(runs):
            passes = True
            for name, limit in self._limits.items():
                value = run.factors.get(name)
                if isinstance(value, float):
                    shifted = limit - 0.01 * (run.case.seed == 2)
                    passes &= value >= limit if self._down else value <= shifted
            results.append(make_run(run, lateral_max_m=0.02 if passes else 0.08))
        return results


def search(**fields: float) -> BoundarySearch:
    return BoundarySearch(**fields)  # type: ignore[arg-type]


def test_bisection_converges_to_the_value_at_which_all_seeds_pass() -> None:
    robot = Robot(robot__robot__mass=17.3, sensors__pose__latency=0.2)
    searches = {
        "robot.robot.mass": search(holds=5.0, beyond=37.0, within=0.5),
        "sensors.pose.latency": search(holds=0.0, beyond=0.5, within=0.02),
    }
    mass, latency = find_boundaries(searches, PROBE, (1, 2), robot.drive, BAND)
    assert mass.held <= 17.29 < mass.failed
    assert mass.failed - mass.held <= 0.5
    # The seed with the lower threshold decides.
    assert latency.held <= 0.19 < latency.failed
    # 32 kg to 0.5 kg are six halvings after the two ends; both factors were searched in the same rounds.
    assert (len(mass.values), robot.rounds) == (8, 8)


def test_search_ends_after_one_value_at_each_end_without_a_boundary() -> None:
    searches = {"surface.friction": search(holds=0.8, beyond=2.0, within=0.05)}
    (failing,) = find_boundaries(searches, PROBE, (1,), Robot(surface__friction=0.1).drive, BAND)
    assert (failing.held, failing.failed, list(failing.values)) == (None, 0.8, [0.8])
    (passing,) = find_boundaries(searches, PROBE, (1,), Robot(surface__friction=9.0).drive, BAND)
    assert (passing.held, passing.failed, list(passing.values)) == (2.0, None, [0.8, 2.0])


def test_unsafe_runs_are_counted_and_come_first_among_the_worst() -> None:
    runs = [make_run(PROBE.with_seed(seed)) for seed in range(20)]
    runs[4] = make_run(PROBE.with_seed(4), unsafe_slew=3)
    runs[9] = make_run(PROBE.with_seed(9), completed=False, position_rmse_m=0.5, lateral_max_m=0.4)
    runs[7] = make_run(PROBE.with_seed(7), completed=False, position_rmse_m=2.0, last_mode="STOPPED")
    runs[2] = make_run(PROBE.with_seed(2), completed=False, error="ValueError: x", position_rmse_m=None)
    assert [run.definition.case.seed for run in worst(runs, 3)] == [4, 2, 9]
    assert worst(runs, 20)[-1] is runs[7]
    assert [is_unsafe(run) for run in runs].index(True) == 4
    outcomes = Outcomes.of_runs(runs, BAND)
    assert (outcomes.unsafe.count, outcomes.completed.count, outcomes.stopped.count, outcomes.in_band.count) == (
        1,
        17,
        1,
        17,
    )
    text = "\n".join(facts(runs, 5))
    assert "1 of 20 runs had an unsafe command: with 95 % confidence, the rate is below 21.6 %" in text
    assert "1 runs ended in an error" in text
    unsafe = next(table for table in tables(runs, [], {}, 3, BAND) if table.title == "Unsafe commands")
    assert {row[0]: row[1:3] for row in unsafe.rows}["above the slew or the braking limit"] == ("3", "1 of 20")


def test_proof_of_too_many_runs_raises_config_error(tmp_path: Path) -> None:
    proof = read_yaml(PROOF)
    axis = {"factor": "surface.slope", "low": 0.0, "high": 1.0, "steps": 100}
    first_map = next(iter(proof["maps"].values()))
    axis["factor"] = first_map["x"]["factor"]
    letters = "abcdefghijklmnopqrstuvwxyz"
    proof["maps"] = {f"map-{a}{b}": {"x": axis, "y": axis} for a in letters for b in letters}
    file = tmp_path / "proof.yaml"
    file.write_text(str(proof).replace("None", "null").replace("True", "true").replace("False", "false"))
    with pytest.raises(ConfigError, match=r"6,7\d\d,\d\d\d runs are requested, the limit is 1,000,000"):
        load_proof(file)


def test_search_for_a_boundary_ends_at_the_resolution_of_floats() -> None:
    search = Boundary("f", BoundarySearch(holds=1.0, beyond=1.00001, within=1e-300))
    count = 0
    while (value := search.next_value) is not None:
        search.take(value, int(value < 1.000004), 1)
        count += 1
        assert count < 40
    assert search.held == pytest.approx(1.000004, abs=1e-8)


TRIALS = 1500
ERROR_RATE = 1e-4
"""Probability that a test of a correct product fails with another seed."""


@pytest.mark.parametrize(("count", "level"), [(19, 0.95), (59, 0.95), (40, 0.8)])
def test_one_score_per_group_covers_with_the_exact_probability(count, level):
    """Split conformal: the k-th of n scores, k = ceil(level (n + 1)), covers with probability k / (n + 1)."""
    stream = np.random.default_rng(1)
    covered = 0
    for scores in stream.lognormal(size=(TRIALS, count + 1)):
        covered += scores[0] <= conformal_quantile(list(scores[1:, None]), level)
    exact = math.ceil(round(level * (count + 1), 9)) / (count + 1)
    low, high = binom.interval(1.0 - ERROR_RATE, TRIALS, exact)
    assert low <= covered <= high


def test_groups_of_dependent_scores_cover_at_least_the_level():
    """The scores of one drive are similar, drives differ, and some drives have many more scores."""
    stream, level, covered = np.random.default_rng(2), 0.9, 0
    for _ in range(TRIALS):
        groups = [stream.lognormal(sigma=1.0) * stream.uniform(0.8, 1.2, stream.integers(1, 30)) for _ in range(40)]
        covered += stream.choice(groups[0]) <= conformal_quantile(groups[1:], level)
    assert covered >= binom.ppf(ERROR_RATE, TRIALS, level)
    # The coverage exceeds the level by at most the weight of one group.
    assert covered <= binom.ppf(1.0 - ERROR_RATE, TRIALS, level + 1 / 40 + 0.01)


def test_group_has_the_weight_of_one_score():
    scores = [np.full(1000, 9.0)] + [np.array([float(k)]) for k in range(1, 9)]
    assert conformal_quantile(scores, 0.8) == 8.0


def test_too_few_groups_and_lost_drives_give_no_bound():
    assert conformal_quantile([np.array([1.0])] * 18, 0.95) == math.inf
    assert conformal_quantile([np.array([1.0])] * 19, 0.95) == 1.0
    assert conformal_quantile([np.array([1.0])] * 18 + [np.array([math.nan])], 0.95) == math.inf


@pytest.mark.parametrize(("count", "total"), [(0, 9), (59, 59), (117, 119), (20, 40)])
def test_lower_bound_of_a_rate_agrees_with_the_exact_test(count, total):
    bound = Rate.of_runs(count, total).at_least(0.95)
    assert 0.0 <= bound < count / total or count == bound == 0
    # If the bound is the true rate, this count or a higher count has the remaining probability.
    assert count == 0 or binom.sf(count - 1, total, bound) == pytest.approx(0.05)


@pytest.mark.parametrize(("count", "total"), [(3, 40), (39, 40), (20, 40), (1, 300)])
def test_exact_interval_excludes_a_fortieth_on_each_side(count: int, total: int) -> None:
    rate = Rate.of_runs(count, total)
    assert binom.sf(count - 1, total, rate.low) == pytest.approx(0.025)
    assert binom.cdf(count, total, rate.high) == pytest.approx(0.025)
    assert binom.cdf(count, total, rate.bound) == pytest.approx(0.05)


def test_tail_is_the_mean_of_the_worst_twentieth() -> None:
    values = np.random.default_rng(0).permutation(np.arange(1.0, 101.0))
    assert cvar(values) == pytest.approx(np.mean([96, 97, 98, 99, 100]))
    # A twentieth of 30 runs is 1.5 runs.
    assert cvar(np.arange(1.0, 31.0)) == pytest.approx((30 + 0.5 * 29) / 1.5)
    assert cvar(np.arange(1.0, 11.0)) == 10.0
    assert cvar(np.arange(12.0).reshape(2, 6), axis=-1) == pytest.approx([5.0, 11.0])
    # For a normal distribution, the tail is density over probability: 2.0627 standard deviations.
    assert cvar(np.random.default_rng(1).normal(size=400_000)) == pytest.approx(2.0627, abs=0.02)


def test_width_of_a_bootstrap_interval_agrees_with_theory() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, size=400)
    estimate = BootstrapEstimate.of_runs(values, mean)
    half_width = 1.96 * np.std(values) / math.sqrt(400)
    assert estimate.value == pytest.approx(np.mean(values))
    assert (estimate.low, estimate.high) == pytest.approx(
        (estimate.value - half_width, estimate.value + half_width), abs=0.2 * half_width
    )
    assert BootstrapEstimate.of_runs(values, median).value == pytest.approx(np.median(values))
    assert BootstrapEstimate.of_runs(values, mean) == estimate
    shift = BootstrapEstimate.of_same_runs([values, values + 1.0], lambda a, b: mean(b) - mean(a))
    assert (shift.low, shift.high) == pytest.approx((1.0, 1.0))
