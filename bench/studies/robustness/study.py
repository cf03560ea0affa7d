"""The robustness study: every controller under every condition."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from diffdrive_mpc.bench.case import Case, check_count
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases
from diffdrive_mpc.bench.outcomes import STATISTICS
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.studies.robustness.conditions import MARKET, Condition, market_cases
from diffdrive_mpc.bench.studies.robustness.results import Rows, run_condition, study_tables
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.mpc.config.thresholds import STANDING, TURNING

_LOOKS = 1000
"""Samples at which a path is looked at."""
Plan = list[tuple[str, Case]]
"""Name of the condition and what to run under it."""


def turns_on_the_spot(trajectory: str) -> bool:
    """Whether a path asks to turn where it stands."""
    reference = load_trajectory(trajectory)
    twist = reference.sample(np.linspace(0.0, reference.duration, _LOOKS)).twist
    return bool(((np.abs(twist[:, 0]) < STANDING) & (np.abs(twist[:, 1]) > TURNING)).any())


class RobustnessStudy(Study[Plan, Rows]):
    """Conditions x controllers x trajectories x seeds; models vary for the predictive controller only.

    Parameters
    ----------
    conditions
        By name.
    settled
        Time from which on the largest lateral error counts [s].
    controllers, models, trajectories, seeds
        Names as in `bench.case.Case`.
    robots
        How many robots of the population to drive beside the conditions, along each trajectory.
    """

    name = "robustness"
    title = "Robustness"

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
    ) -> None:
        self._robots = robots
        self._conditions, self._settled = conditions, settled
        self._controllers, self._models = controllers, models
        self._trajectories, self._seeds = trajectories, seeds

    def plan(self) -> Plan:
        """The cases; raises ConfigError or ValueError if one of them cannot be run."""
        check_count(self._robots * len(self._controllers) * len(self._models) * len(self._trajectories))
        several = (self._conditions, self._controllers, self._models, self._trajectories, self._seeds)
        check_count(math.prod(map(len, several)))
        unknown = [name for name in self._controllers if name not in CONTROLLERS]
        if unknown:
            raise ConfigError(f"--controllers: unknown controller '{unknown[0]}'; known: {', '.join(CONTROLLERS)}")
        plan = [
            (name, condition.case(controller, model, trajectory, seed))
            for name, condition in self._conditions.items()
            for controller in self._controllers
            for model in (self._models if controller not in PEERS else self._models[:1])
            for trajectory in self._trajectories
            for seed in self._seeds
        ]
        if self._robots:
            plan += [
                (MARKET, case)
                for trajectory in self._trajectories
                for controller in self._controllers
                for model in (self._models if controller not in PEERS else self._models[:1])
                for case in market_cases(self._robots, controller, model, trajectory, turns_on_the_spot(trajectory))
            ]
        check_cases([case for name, case in plan if name != MARKET] or [case for _, case in plan[:1]])
        return plan

    def run(self, plan: Plan, jobs: int, bar: ProgressBar) -> Rows:
        """Run every case; each process keeps only what the study needs."""
        bar.begin(f"running, {jobs} at a time", len(plan))
        return run_tasks([partial(run_condition, name, case, self._settled) for name, case in plan], jobs, bar.advance)

    def report(self, results: Rows, seconds: float) -> Report:
        """Tables, and the figure where there are several controllers to compare."""
        from diffdrive_mpc.bench.studies.robustness.figures import draw_ratios  # noqa: PLC0415

        several = len({one.driver for one in results}) > 1
        return Report(
            counted=f"{len(results)} runs",
            meta={"statistics": STATISTICS, "settled_s": self._settled},
            content={"runs": [one.as_json() for one in results]},
            facts=[
                f"{len(results)} runs in {seconds} s: {len(self._conditions)} conditions along "
                f"{', '.join(self._trajectories)} with the seeds {', '.join(map(str, self._seeds))}"
                + (f", and {self._robots} robots of the market along each path." if self._robots else ".")
            ],
            notes=[f"Errors: {STATISTICS}. Late: from {self._settled:g} s on."],
            tables=study_tables(results),
            figures={"ratios.png": partial(draw_ratios, results)} if several else {},
        )
