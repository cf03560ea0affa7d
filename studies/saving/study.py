"""The saving study: energy-optimal against distance-optimal paths of the same ends, driven on the simulated robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from diffdrive_mpc.bench.html_report.page import KeyFigure, Shown
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.statistics import BootstrapEstimate, mean
from diffdrive_mpc.bench.study import Draw, Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc_extras.turn_costs import load_turn_costs
from diffdrive_mpc_extras.worlds.outline import plant_outline
from studies.saving.drives import AIMS, PairOutcome, PlanDrive, Saved, measure_pair, worse_arrival
from studies.saving.scenarios import (
    ScenarioOutcome,
    check_scenario,
    measure_foreign,
    measure_loaded,
    measure_nominal,
)
from studies.saving.settings import PaperScenario, SavingStudySettings, draw_pairs
from studies.torque.measurements import plant_of

_MEASURES: dict[str, Callable[[SavingStudySettings, PaperScenario], ScenarioOutcome]] = {
    "nominal": measure_nominal,
    "foreign": measure_foreign,
    "loaded": measure_loaded,
}


class SavingResults(NamedTuple):
    """What was found."""

    floors: list[tuple[str, list[PairOutcome]]]
    scenarios: list[ScenarioOutcome]


class SavingStudy(Study[SavingStudySettings, SavingResults]):
    """Pairs on each floor, then the scenarios.

    Parameters
    ----------
    settings
        What to do.
    """

    name = "saving"
    title = "How much an energy-optimal path saves"

    def __init__(self, settings: SavingStudySettings) -> None:
        self._settings = settings

    def plan(self) -> SavingStudySettings:
        """The settings; raises ConfigError if a robot, floor, turn costs or configuration does not exist."""
        asked = self._settings
        load_config(asked.configuration)
        for surface in asked.surfaces:
            load_turn_costs(asked.costs_of(surface))
            plant_of(asked.robot, surface)
        for scenario in asked.scenarios:
            check_scenario(asked, scenario)
        return asked

    def run(self, plan: SavingStudySettings, jobs: int, bar: ProgressBar) -> SavingResults:
        """Plan and drive every pair on every floor, and every scenario."""
        pairs = draw_pairs(plan.pairs, plan.pairs.count, plan.pairs.seed)
        bar.begin("pairs", len(plan.surfaces) * len(pairs))
        tasks = [
            partial(measure_pair, plan, surface, k, pair) for surface in plan.surfaces for k, pair in enumerate(pairs)
        ]
        outcomes = run_tasks(tasks, jobs, bar.advance)
        floors = [
            (surface, [outcome for outcome in outcomes if outcome.surface == surface]) for surface in plan.surfaces
        ]
        bar.begin("scenarios", len(plan.scenarios))
        measures = [partial(_MEASURES[scenario.kind], plan, scenario) for scenario in plan.scenarios]
        return SavingResults(floors, run_tasks(measures, jobs, bar.advance))

    def report(self, results: SavingResults, seconds: float) -> Report:
        """Tables and figures."""
        from studies.saving import figures  # noqa: PLC0415 - matplotlib

        asked = self._settings
        outline = plant_outline(f"mujoco:{asked.robot}")
        draws: dict[str, Draw] = {"saving.png": partial(figures.draw_saving, results.floors, asked.asked)}
        draws["prediction.png"] = partial(figures.draw_prediction, results.floors)
        for surface, outcomes in results.floors:
            draws[f"paths-{surface}.png"] = partial(figures.draw_paths, outcomes, surface)
        for k, scenario in enumerate(results.scenarios):
            draws[f"scenario-{k + 1}.png"] = partial(figures.draw_scenario, scenario, outline)
        pairs = [outcome for _, outcomes in results.floors for outcome in outcomes]
        drives = sum(len(pair.drives) + (pair.fed is not None) for pair in pairs)
        drawn = asked.pairs
        return Report(
            counted=f"{drives} drives, {len(results.scenarios)} scenarios",
            meta={"robot": asked.robot, "speed_m_s": asked.speed, "pairs": drawn.count, "pair_seed": drawn.seed},
            content=_content(results, asked.computer),
            facts=[
                f"Robot '{asked.robot}' in the physics, at {asked.speed:g} m/s at most, in {seconds} s; "
                f"{drawn.count} pairs from seed {drawn.seed}, {drawn.distance[0]:g} to {drawn.distance[1]:g} m apart, "
                "the goal in any direction and with any heading there: a Latin hypercube.",
                "Both drives of a pair: the same floor, noise, controller, cap of speed and ramps, from rest to rest "
                "at the same poses.",
            ],
            notes=[
                "Energy: from the battery until the robot stands, by true torque and speed of each motor in each step "
                "of the physics. Saving: what the energy-optimal drive takes less, over the other; intervals are "
                "bootstrapped over the pairs.",
                "Predicted: by the plan, before it is driven.",
            ],
            tables=_tables(results, asked.computer),
            figures=draws,
            shown=Shown(
                key_figures=[_key_figure(surface, savings, asked.asked) for surface, savings in results.floors]
            ),
        )


def _key_figure(surface: str, outcomes: Sequence[PairOutcome], least: float) -> KeyFigure:
    mean = Saved.of(outcomes).mean
    note = f"95 % interval {_interval(mean)} %; asked: {least:g} %"
    return KeyFigure(
        f"saved on {surface}", f"{_percent(mean.value)} %", note, "good" if 100 * mean.value >= least else "bad"
    )


def _tables(results: SavingResults, computer: float) -> list[Table]:
    floors = results.floors
    saved = [((surface,), (outcomes, Saved.of(outcomes))) for surface, outcomes in floors]
    floors_by_name = [((surface,), outcomes) for surface, outcomes in floors]
    saving = Table.of(
        "Saving",
        ("floor",),
        {
            "pairs": lambda row: str(row[1].pairs),
            "mean [%]": lambda row: _percent(row[1].mean.value),
            "95 % interval [%]": lambda row: _interval(row[1].mean),
            "least [%]": lambda row: _percent(row[1].least),
            "most [%]": lambda row: _percent(row[1].most),
            "took more": lambda row: str(row[1].worse),
            "of all energy [%]": lambda row: _percent(row[1].total),
            "by the plans [%]": lambda row: _percent(row[1].predicted),
            "longer way [%]": lambda row: _percent(
                _longer([(each.drives.get("energy"), each.drives.get("distance")) for each in row[0]])
            ),
            f"beside {computer:g} W [%]": lambda row: _percent(_beside(row[0], computer)),
        },
        saved,
        note="Energy-optimal against distance-optimal. Took more: pairs whose energy-optimal drive did. Beside: mean "
        "saving of the same drives, were a computer to draw so much as long as they last; not planned with it.",
    )
    fed = Table.of(
        "Saving with a computer",
        ("floor",),
        {
            "pairs": lambda row: str(len(_savings_fed(row, computer))),
            "mean [%]": lambda row: _percent(_fed(row, computer).value),
            "95 % interval [%]": lambda row: _interval(_fed(row, computer)),
            "took more": lambda row: str(int(np.count_nonzero(_savings_fed(row, computer) < 0))),
            "longer way [%]": lambda row: _percent(_longer([(each.fed, each.drives.get("distance")) for each in row])),
        },
        floors_by_name,
        note=f"Energy-optimal against distance-optimal for a robot whose computer draws {computer:g} W as long as it "
        "drives, planned with it.",
    )
    over_time = [((surface,), Saved.of(outcomes, "time")) for surface, outcomes in floors]
    against_time = Table.of(
        "Against time-optimal",
        ("floor",),
        {
            "pairs": lambda row: str(row.pairs),
            "mean [%]": lambda row: _percent(row.mean.value),
            "95 % interval [%]": lambda row: _interval(row.mean),
            "by the plans [%]": lambda row: _percent(row.predicted),
        },
        over_time,
        note="Energy-optimal against time-optimal.",
    )
    by_aim = [
        ((surface, aim), [outcome.drives[aim] for outcome in outcomes if aim in outcome.drives])
        for surface, outcomes in floors
        for aim in AIMS
    ]
    driven = [(names, drives) for names, drives in by_aim if drives]
    arrival = Table.of(
        "Arrival",
        ("floor", "least"),
        {
            "drives": lambda drives: str(len(drives)),
            "arrived": lambda drives: str(sum(drive.arrived for drive in drives)),
            "position, mean [mm]": lambda drives: number(1e3 * _mean(drives, "position"), 1),
            "most [mm]": lambda drives: number(1e3 * max(drive.position for drive in drives), 1),
            "heading, mean [deg]": lambda drives: number(math.degrees(_mean(drives, "heading")), 2),
            "most [deg]": lambda drives: number(math.degrees(max(drive.heading for drive in drives)), 2),
            "lateral, RMSE [mm]": lambda drives: number(1e3 * _mean(drives, "lateral"), 1),
            "at the limit [%]": lambda drives: _percent(_mean(drives, "saturated")),
        },
        driven,
        note="Where the robot stands, from the end of the plan. At the limit: share of the time in which a motor gives "
        "95 % of its limit or more.",
    )
    prediction = Table.of(
        "Energy predicted",
        ("floor", "least"),
        {
            "measured, mean [J]": lambda drives: number(_mean(drives, "measured"), 1),
            "predicted, mean [J]": lambda drives: number(_mean(drives, "predicted"), 1),
            "off, mean [%]": lambda drives: _percent(_mean(drives, "error")),
            "off, RMS [%]": lambda drives: _percent(math.sqrt(float(np.mean([drive.error**2 for drive in drives])))),
            "way, mean [m]": lambda drives: number(_mean(drives, "length"), 2),
            "time, mean [s]": lambda drives: number(_mean(drives, "seconds"), 1),
        },
        [(names, arrived) for names, drives in driven if (arrived := [drive for drive in drives if drive.arrived])],
        note="Of drives that arrived.",
    )
    scenarios = Table.of(
        "Scenarios",
        ("scenario", "plan"),
        {
            "predicted [J]": lambda row: number(row.open.predicted, 1),
            "open loop [J]": lambda row: number(row.open.measured, 1),
            "off [%]": lambda row: _percent(row.open.error),
            "ends off [m]": lambda row: number(row.open.position, 2),
            "cone [m]": lambda row: number(row.gaps[0], 2),
            "controller [J]": lambda row: number(row.closed.measured, 1),
            "its prediction off [%]": lambda row: _percent(row.closed.error),
            "it ends off [m]": lambda row: number(row.closed.position, 3),
            "its cone [m]": lambda row: number(row.gaps[1], 2),
            "saved [%]": lambda row: _percent(row.saving),
        },
        [((scenario.short, plan.by), plan) for scenario in results.scenarios for plan in scenario.plans],
        note="Cone: from the robot's outline to the nearest one; below zero it ran over it. Saved: against the "
        "distance-optimal plan of the same knowledge, both by the controller.",
    )
    tables = [saving, fed, against_time, arrival, prediction, scenarios]
    return [table for table in tables if table.rows]


def _content(results: SavingResults, computer: float) -> dict[str, Any]:
    pairs = [
        {
            "surface": outcome.surface,
            "number": outcome.number,
            "goal": list(outcome.pair.goal),
            "saving": outcome.saving(),
            "saving_over_time": outcome.saving("time"),
            "told": outcome.told,
            **{aim: _plain(drive) for aim, drive in outcome.drives.items()},
            **({"energy_with_computer": _plain(outcome.fed)} if outcome.fed else {}),
        }
        for _, outcomes in results.floors
        for outcome in outcomes
    ]
    floors = []
    for surface, outcomes in results.floors:
        saved, (position, heading) = Saved.of(outcomes), worse_arrival(outcomes)
        fed = _fed(outcomes, computer)
        floors.append(
            {
                "surface": surface,
                "pairs": saved.pairs,
                "saving": saved.mean.value,
                "saving_interval": [saved.mean.low, saved.mean.high],
                "saving_of_all_energy": saved.total,
                "saving_with_computer": fed.value,
                "saving_with_computer_interval": [fed.low, fed.high],
                "saving_by_the_plans": saved.predicted,
                "position_worse_m": [position.value, position.low, position.high],
                "heading_worse_rad": [heading.value, heading.low, heading.high],
            }
        )
    scenarios = [
        {
            "title": scenario.title,
            "figures": scenario.figures,
            "plan": plan.by,
            "gaps_m": list(plan.gaps),
            "saving": plan.saving,
            "open": _plain(plan.open),
            "closed": _plain(plan.closed),
            "distance": _plain(plan.distance),
        }
        for scenario in results.scenarios
        for plan in scenario.plans
    ]
    return {"floors": floors, "scenarios": scenarios, "pairs": pairs}


def _plain(drive: PlanDrive) -> dict[str, Any]:
    return {name: value for name, value in drive._asdict().items() if name not in ("planned", "path")} | {
        "error": drive.error
    }


def _longer(drives: Sequence[tuple[PlanDrive | None, PlanDrive | None]]) -> float:
    """By how much the first plans are longer than the second, all together [-]."""
    both = [(one.length, other.length) for one, other in drives if one is not None and other is not None]
    if not both:
        return math.nan
    own, others = np.sum(both, axis=0)
    return float(own / others - 1)


def _savings_fed(outcomes: Sequence[PairOutcome], computer: float) -> FloatArray:
    """Of the pairs for which both drives arrived [-]."""
    savings = np.array([outcome.saving_fed(computer) for outcome in outcomes])
    return np.asarray(savings[np.isfinite(savings)])


def _fed(outcomes: Sequence[PairOutcome], computer: float) -> BootstrapEstimate:
    return BootstrapEstimate.of_runs(_savings_fed(outcomes, computer), mean)


def _beside(outcomes: Sequence[PairOutcome], computer: float) -> float:
    """Mean saving were so much power [W] drawn all the time [-]."""
    savings = [outcome.saving(computer=computer) for outcome in outcomes]
    return float(np.mean([saving for saving in savings if math.isfinite(saving)] or [math.nan]))


def _mean(drives: Sequence[PlanDrive], what: str) -> float:
    return float(np.mean([getattr(drive, what) for drive in drives]))


def _percent(share: float) -> str:
    return number(100 * share, 1)


def _interval(savings: BootstrapEstimate) -> str:
    return f"{_percent(savings.low)} to {_percent(savings.high)}"
