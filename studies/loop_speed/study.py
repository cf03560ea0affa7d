"""How many times as fast as real time a closed loop is simulated on one core, whole and by part."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build, check_cases, make_controller
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.bench.timing import quiet_core, replay
from diffdrive_mpc.sim import Plant, Run, simulate

T = TypeVar("T")


@dataclass(frozen=True)
class LoopCost:
    """Processor time of one drive, the least of several times it was driven.

    Attributes
    ----------
    case
        What is driven.
    ticks, driven
        How many, and for how long [s].
    loop
        The loop without its statistics [s].
    metrics
        The statistics afterwards [s].
    controller, plant
        Of the loop, by giving each once more what it was given in it [s].
    """

    case: Case
    ticks: int
    driven: float
    loop: float
    metrics: float
    controller: float
    plant: float

    @property
    def whole(self) -> float:
        """Loop and statistics [s]."""
        return self.loop + self.metrics

    @property
    def rest(self) -> float:
        """What the loop takes beside controller and plant [s]."""
        return self.loop - self.controller - self.plant


class LoopSpeedStudy(Study[list[Case], list[LoopCost]]):
    """Drives in turn on one core, so that whatever else the machine does meets all of them.

    Parameters
    ----------
    models, trajectories
        Every model on every one of these.
    plant, scenario
        Where, and what happens there.
    repeats
        How often each is driven.
    """

    name, title = "loop-speed", "How fast the closed loop is simulated"

    def __init__(
        self, models: Sequence[str], trajectories: Sequence[str], plant: str, scenario: str, repeats: int
    ) -> None:
        self._models, self._trajectories, self._repeats = models, trajectories, repeats
        self._plant, self._scenario = plant, scenario

    def plan(self) -> list[Case]:
        """Every model on every path; raises ConfigError if one of them, or the plant, does not exist."""
        cases = [
            Case(model=model, trajectory=trajectory, plant=self._plant, scenario=self._scenario)
            for model in self._models
            for trajectory in self._trajectories
        ]
        check_cases(cases)
        return cases

    def run(self, plan: list[Case], jobs: int, bar: ProgressBar) -> list[LoopCost]:  # noqa: ARG002 - one alone
        """Drive in turn, in this process alone: `jobs` processes would share caches and clock."""
        bar.begin("driving", self._repeats * len(plan))
        costs: dict[Case, LoopCost] = {}
        with quiet_core():
            for _ in range(self._repeats):
                for case in plan:
                    cost = _measure(case)
                    costs[case] = _least(costs.get(case, cost), cost)
                    bar.advance()
        return list(costs.values())

    def report(self, results: list[LoopCost], seconds: float) -> Report:
        """Multiples of real time, and microseconds a tick."""
        names = ("model", "trajectory")
        entries = [((result.case.model, result.case.trajectory), result) for result in results]
        speeds: dict[str, Callable[[LoopCost], str]] = {
            "whole [x]": lambda row: number(row.driven / row.whole, 0),
            "loop [x]": lambda row: number(row.driven / row.loop, 0),
            "plant [x]": lambda row: number(row.driven / row.plant, 0),
            "controller [x]": lambda row: number(row.driven / row.controller, 0),
        }
        parts: dict[str, Callable[[LoopCost], str]] = {
            f"{name} [us]": _per_tick(name) for name in ("whole", "plant", "controller", "rest", "metrics")
        }
        tables = [
            Table.of("Times real time", names, speeds, entries, "Simulated time over processor time, on one core."),
            Table.of("A tick", names, parts, entries, "Rest: what the loop itself takes, records included."),
        ]
        rows = [_named(result.case) | {k: v for k, v in asdict(result).items() if k != "case"} for result in results]
        fact = (
            f"{len(results)} drives, {self._repeats} times each in turn, in {seconds} s; plant {self._plant}, "
            f"scenario {self._scenario}; processor time, the least of each."
        )
        return Report(f"{len(results)} drives", {"repeats": self._repeats}, {"runs": rows}, [fact], tables)


def _per_tick(part: str) -> Callable[[LoopCost], str]:
    return lambda row: number(1e6 * getattr(row, part) / row.ticks, 0)


def _named(case: Case) -> dict[str, object]:
    return {"model": case.model, "trajectory": case.trajectory, "plant": case.plant, "scenario": case.scenario}


def _measure(case: Case) -> LoopCost:
    controller, plant, reference = build(case)
    run, loop = _timed(lambda: simulate(controller, plant, reference))
    _, metrics = _timed(lambda: run.metrics)
    again = make_controller(case)
    again.start(reference, 0.0)
    _, replayed = _timed(lambda: replay(again, run, 0, len(run.time)))
    _, driven = _timed(lambda: _drive(plant, run))
    duration = len(run.time) * run.sample_time
    return LoopCost(case, len(run.time), duration, loop, metrics, replayed, driven)


def _drive(plant: Plant, run: Run) -> None:
    """Give the plant the commands of `run` again, as the loop does."""
    plant.reset(run.reference.sample([0.0]).pose[0])
    for command in run.command:
        plant.measure()
        plant.advance(command)


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    began = time.process_time()
    result = work()
    return result, time.process_time() - began


def _least(cost: LoopCost, other: LoopCost) -> LoopCost:
    times = {
        name: min(getattr(cost, name), getattr(other, name)) for name in ("loop", "metrics", "controller", "plant")
    }
    return replace(cost, **times)
