"""Each pair planned and driven for energy, for distance and for time; what was saved, pair by pair."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.bench.statistics import Estimate, mean
from diffdrive_mpc.extras.planner import Objective, PlanError, plan, plan_each
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.turn_costs import load_turn_costs
from studies.saving.drives import Driven, drive_closed
from studies.saving.pairs import Pair
from studies.saving.settings import SavingStudySettings

AIMS: tuple[Objective, ...] = ("energy", "distance", "time")
"""What is made least, in the order of the tables."""


class PairOutcome(NamedTuple):
    """One pair on one floor."""

    surface: str
    number: int
    pair: Pair
    drives: Mapping[Objective, Driven]
    """By aim; none where there is no plan"""
    fed: Driven | None
    """energy-optimal where a computer on board is fed as long as it lasts; its energy has both"""
    told: str
    """Why there is no plan; empty where there is one for each aim"""

    def saving(self, over: Objective = "distance", *, computer: float = 0.0) -> float:
        """Energy that the energy-optimal drive takes less than another, over that of the other [-]; NaN without both.

        Of drives that did not arrive nothing is said. `computer` is power that is drawn all the time beside [W].
        """
        own, other = self.drives.get("energy"), self.drives.get(over)
        if own is None or other is None or not (own.arrived and other.arrived):
            return math.nan
        return 1 - (own.measured + computer * own.seconds) / (other.measured + computer * other.seconds)

    def saving_fed(self, computer: float) -> float:
        """What the energy-optimal drive takes less than the distance-optimal [-], where a computer draws so much [W].

        The first was planned with the computer; NaN as above.
        """
        other = self.drives.get("distance")
        if self.fed is None or other is None or not (self.fed.arrived and other.arrived):
            return math.nan
        return 1 - self.fed.measured / (other.measured + computer * other.seconds)

    def promised(self, over: Objective = "distance") -> float:
        """The same by the plans [-]."""
        return 1 - self.drives["energy"].predicted / self.drives[over].predicted


def measure_pair(asked: SavingStudySettings, surface: str, number: int, pair: Pair) -> PairOutcome:
    """Plan and drive one pair, for each aim by the same rules: cap of speed, ramps, controller, floor, noise."""
    costs, settings = load_turn_costs(asked.costs_of(surface)), asked.planning.settings
    try:
        plans = plan_each(costs, pair.start, pair.goal, speed=asked.speed, settings=settings)
        with_computer = costs.with_idle_power(costs.drive.idle_power + asked.computer)
        fed = plan(with_computer, pair.start, pair.goal, speed=asked.speed, settings=settings)
    except PlanError as error:
        return PairOutcome(surface, number, pair, {}, None, str(error))
    drives = {aim: drive_closed(asked, plans[aim], surface) for aim in AIMS}
    beside = drive_closed(asked, fed, surface, beside=asked.computer)
    return PairOutcome(surface, number, pair, drives, beside, "")


class Saved(NamedTuple):
    """What was saved on one floor, over its pairs; means with bootstrap intervals."""

    pairs: int
    """for which both drives arrived"""
    mean: Estimate
    """over the savings of the pairs [-]"""
    total: float
    """of the sum of all drives [-]"""
    least: float
    most: float
    worse: int
    """pairs whose energy-optimal drive took more"""
    predicted: float
    """mean saving by the plans [-]"""

    @classmethod
    def of(cls, outcomes: Sequence[PairOutcome], over: Objective = "distance") -> Saved:
        """Of the pairs of a floor."""
        both = [one for one in outcomes if math.isfinite(one.saving(over))]
        found = np.array([one.saving(over) for one in both])
        if not both:
            return cls(0, Estimate.of_runs([], mean), math.nan, math.nan, math.nan, 0, math.nan)
        own, other = (sum(one.drives[aim].measured for one in both) for aim in ("energy", over))
        return cls(
            len(both),
            Estimate.of_runs(found, mean),
            1 - own / other,
            float(found.min()),
            float(found.max()),
            int(np.count_nonzero(found < 0)),
            float(np.mean([one.promised(over) for one in both])),
        )


def worse_arrival(outcomes: Sequence[PairOutcome]) -> tuple[Estimate, Estimate]:
    """By how much the energy-optimal drive ends further off than the distance-optimal: position [m], heading [rad]."""
    both = [one for one in outcomes if {"energy", "distance"} <= {*one.drives}]

    def differences(what: str) -> FloatArray:
        return np.array([getattr(one.drives["energy"], what) - getattr(one.drives["distance"], what) for one in both])

    return Estimate.of_runs(differences("position"), mean), Estimate.of_runs(differences("heading"), mean)
