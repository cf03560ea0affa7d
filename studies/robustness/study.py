"""Robustness study: runs of all controllers under all conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.case import Case, check_count
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases
from diffdrive_mpc.bench.experiment import ExperimentRun, by, drive_all, json_rows
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import STATISTICS
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.mpc.config.fixed_values import STANDING, TURNING
from diffdrive_mpc_extras.campaign.campaign_file import Condition
from studies.robustness.results import FALSE_ALARM_RATE, MARKET, condition_columns, market_cases, study_tables

OUR_CONTROLLER = "mpc"
"""Name of the predictive controller in `bench.case.Case`."""
_SAMPLES = 1000
"""Number of samples of a path in the search for turns on the spot."""
Plan = list[tuple[str, Case]]
"""Pairs of the name of a condition and a case."""


def has_spot_turns(trajectory: str) -> bool:
    """Return True if a path contains turns on the spot."""
    reference = load_trajectory(trajectory)
    twist = reference.sample(np.linspace(0.0, reference.duration, _SAMPLES)).twist
    return bool(((np.abs(twist[:, 0]) < STANDING) & (np.abs(twist[:, 1]) > TURNING)).any())


class RobustnessStudy(Study[Plan, DataFrame]):
    """Study of all combinations of conditions, controllers, trajectories and seeds.

    The predictive controller is also combined with each of the models.

    Parameters
    ----------
    conditions
        Conditions by name.
    settled
        Time from which the settled lateral error is evaluated [s].
    controllers, models, trajectories, seeds
        Names and seeds as in `bench.case.Case`.
    robots
        Number of random robots that drive along each trajectory, in addition to the conditions.
    tuning
        True to use the robots for tuning instead of the reserved robots.
    rates
        Additional rates of false alarms [1/h] of the predictive controller on random robots.
    """

    name = "robustness"
    title = "Tracking error on other robots, surfaces, loads and sensors"

    def __init__(
        self,
        conditions: Mapping[str, Condition],
        settled: float,
        *,
        controllers: Sequence[str],
        models: Sequence[str],
        trajectories: Sequence[str],
        seeds: Sequence[int],
        robots: int = 0,
        tuning: bool = False,
        rates: Sequence[float] = (),
    ) -> None:
        if robots and not conditions:
            self.title = "Tracking error of random robots"  # type: ignore[misc]
        self._robots, self._tuning, self._rates = robots, tuning, rates
        self._conditions, self._settled = conditions, settled
        self._controllers, self._models = controllers, models
        self._trajectories, self._seeds = trajectories, seeds

    def plan(self) -> Plan:
        """Plan the cases; raise ConfigError or ValueError if a case is not possible."""
        drives = len(self._controllers) * len(self._models) + len(self._rates)
        check_count(self._robots * drives * len(self._trajectories))
        factors = (self._conditions, self._controllers, self._models, self._trajectories, self._seeds)
        check_count(math.prod(map(len, factors)))
        unknown = [name for name in self._controllers if name not in CONTROLLERS]
        if unknown:
            raise ConfigError(f"--controllers: unknown controller {format_unknown_name(unknown[0], CONTROLLERS)}")
        plan = [
            (name, condition.case(controller, model, trajectory, seed))
            for name, condition in self._conditions.items()
            for controller in self._controllers
            for model in (self._models if controller not in PEERS else self._models[:1])
            for trajectory in self._trajectories
            for seed in self._seeds
        ]
        check_cases([case for _, case in plan])
        market = self._market()
        check_cases([case for _, case in market[:1]])
        return plan + market

    def _market(self) -> Plan:
        """Plan cases with random robots: all controllers at the configured rate of false alarms, mpc at all rates."""
        if not self._robots:
            return []
        drivers = [
            (controller, model)
            for controller in self._controllers
            for model in (self._models if controller not in PEERS else self._models[:1])
        ]
        variants: list[tuple[str, str, str, dict[str, float]]] = [(MARKET, *driver, {}) for driver in drivers]
        variants += [
            (f"{MARKET}, {rate:g}/h", OUR_CONTROLLER, self._models[0], {FALSE_ALARM_RATE: rate}) for rate in self._rates
        ]
        return [
            (name, case)
            for name, controller, model, settings in variants
            for trajectory in self._trajectories
            for case in market_cases(
                self._robots,
                controller,
                model,
                trajectory,
                has_spot_turns(trajectory),
                tuning=self._tuning,
                settings=settings,
            )
        ]

    def run(self, plan: Plan, jobs: int, bar: ProgressBar) -> DataFrame:
        """Run all cases; the results contain only the columns of the tables."""
        bar.start_stage(f"running, {jobs} at a time", len(plan))
        drives = [ExperimentRun(case, {"condition": name}) for name, case in plan]
        return drive_all(drives, jobs, bar.advance, partial(condition_columns, self._settled))

    def report(self, results: DataFrame, seconds: float) -> Report:
        """Build the report with tables, and with a figure if there are several controllers."""
        from studies.robustness.results import draw_ratios  # noqa: PLC0415

        has_comparison = len(by(results, "driver")) > 1
        return Report(
            size=f"{len(results)} runs",
            meta={"statistics": STATISTICS, "settled_s": self._settled},
            content={"runs": json_rows(results)},
            facts=[
                f"{len(results)} runs in {seconds} s: {len(self._conditions)} conditions along "
                f"{', '.join(self._trajectories)} with the seeds {', '.join(map(str, self._seeds))}"
                + (f", and {self._robots} robots of the market along each path." if self._robots else ".")
            ],
            notes=[f"Errors: {STATISTICS}. Settled: after {self._settled:g} s."],
            tables=study_tables(results),
            figures={"ratios.png": partial(draw_ratios, results)} if has_comparison else {},
        )
