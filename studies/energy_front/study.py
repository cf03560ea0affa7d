"""The front: energy against tracking error, as the weight of energy grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from diffdrive_mpc.bench.case import Case, label
from diffdrive_mpc.bench.controllers import check_cases, run_case
from diffdrive_mpc.bench.html_report.page import KeyFigure, Shown
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.statistics import BootstrapEstimate, mean
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.robot import NotNegative, Positive
from diffdrive_mpc_extras.energy.power_readings import robot_power, run_energy

# What the study of the front does: `study.yaml` says what each value is.


HERE = Path(__file__).parent


class FrontFloor(StrictModel):
    """A floor, what turns cost on it, and the paths that are driven there."""

    surface: str
    turn_costs: str
    trajectories: Annotated[tuple[str, ...], Field(min_length=1)]


class FrontSettings(StrictModel):
    """All of it."""

    plant: str
    config: str
    top_speed: Positive
    weights: Annotated[tuple[NotNegative, ...], Field(min_length=2)]
    seeds: Annotated[tuple[int, ...], Field(min_length=1)]
    floors: Annotated[tuple[FrontFloor, ...], Field(min_length=1)]

    def cases(self, folder: Path) -> list[Case]:
        """Every run; files are named as seen from `folder`."""
        return [
            self._case(floor, name, weight, seed, folder)
            for floor in self.floors
            for name in floor.trajectories
            for weight in self.weights
            for seed in self.seeds
        ]

    def _case(self, floor: FrontFloor, name: str, weight: float, seed: int, folder: Path) -> Case:
        own = folder / name
        drawn = own.is_file()
        overrides = (("energy.turn_costs", floor.turn_costs), ("energy.weight", weight))
        return Case(
            model=str(folder / self.config).replace("config.yaml", "model.yaml"),
            trajectory=str(own) if drawn else name,
            plant=self.plant,
            surface=floor.surface,
            seed=seed,
            config=str(folder / self.config),
            overrides=overrides,
            top_speed=None if drawn else self.top_speed,
        )


def load_study(path: Path | None = None) -> FrontSettings:
    """Read what to do; raises ConfigError on a mistake in the file."""
    return load_checked(FrontSettings, path or HERE / "study.yaml")


def small(study: FrontSettings) -> FrontSettings:
    """One path, three weights and two seeds, to see that it works."""
    floor = study.floors[0].model_copy(update={"trajectories": study.floors[0].trajectories[:1]})
    return study.model_copy(update={"floors": (floor,), "weights": (0.0, 0.005, 0.05), "seeds": (0, 1)})


@dataclass(frozen=True)
class FrontRun:
    """One run: energy from the battery [J], errors [m], and whether it came to its end."""

    surface: str
    trajectory: str
    weight: float
    seed: int
    energy: float
    error: float
    lateral: float
    completed: bool


@dataclass(frozen=True)
class FrontPoint:
    """One weight on one path and floor, over seeds; `saved` is over the same seeds without [-]."""

    weight: float
    energy: BootstrapEstimate
    error: BootstrapEstimate
    lateral: BootstrapEstimate
    saved: BootstrapEstimate
    completed: int
    of: int


# Of the error without a weight [-].
_FACTORS = (1.0, 1.5, 2.0, 5.0)

Fronts = dict[tuple[str, str], list[FrontPoint]]


def drive(case: Case) -> FrontRun:
    """Drive one case."""
    run = run_case(case)
    metrics, weight = run.metrics, dict(case.overrides)["energy.weight"]
    assert isinstance(weight, float)
    energy = run_energy(run, robot_power(case.plant).drive).energy_j
    values = (energy, metrics.position_rmse_m, metrics.lateral_rmse_m)
    return FrontRun(case.surface, label(case.trajectory), weight, case.seed, *values, metrics.completed)


def fronts(driven: Sequence[FrontRun]) -> Fronts:
    """The front of each floor and path, weights ascending; the first is none."""
    by_place: Fronts = {}
    for floor, path in dict.fromkeys((run.surface, run.trajectory) for run in driven):
        there = [run for run in driven if (run.surface, run.trajectory) == (floor, path)]
        without = {run.seed: run.energy for run in there if run.weight == 0.0}
        by_place[floor, path] = []
        for weight in sorted({run.weight for run in there}):
            here = [run for run in there if run.weight == weight]

            def over(values: Sequence[float] | FloatArray) -> BootstrapEstimate:
                return BootstrapEstimate.of_runs(np.asarray(values, dtype=float), mean)

            by_place[floor, path].append(
                FrontPoint(
                    weight,
                    over([run.energy for run in here]),
                    over([run.error for run in here]),
                    over([run.lateral for run in here]),
                    over([1.0 - run.energy / without[run.seed] for run in here]),
                    sum(run.completed for run in here),
                    len(here),
                )
            )
    return by_place


class EnergyFrontStudy(Study[list[Case], list[FrontRun]]):
    """Paths with corners, driven with one weight of energy after the other.

    Parameters
    ----------
    settings
        What to do.
    folder
        From where it names files.
    """

    name = "energy-front"
    title = "Energy saved by the controller's energy weight, and the tracking error it costs"

    def __init__(self, settings: FrontSettings, folder: Path = HERE) -> None:
        self._settings, self._folder = settings, folder

    def plan(self) -> list[Case]:
        """Every run; raises ConfigError if something that is named does not exist."""
        cases = self._settings.cases(self._folder)
        check_cases(cases)
        return cases

    def run(self, plan: list[Case], jobs: int, bar: ProgressBar) -> list[FrontRun]:
        """Drive all of them."""
        bar.begin("driving", len(plan))
        return run_tasks([partial(drive, case) for case in plan], jobs, bar.advance)

    def report(self, results: list[FrontRun], seconds: float) -> Report:
        """A table and a figure."""
        from studies.energy_front.figures import draw_front  # noqa: PLC0415 - matplotlib

        by_place = fronts(results)
        best = max((_best(points, 2.0) for points in by_place.values()), key=lambda row: row.saved.value)
        brief = Table.of(
            "Saved within an error",
            ("floor", "path"),
            {
                "energy without [J]": lambda points: number(points[0].energy.value, 1),
                "error without [mm]": lambda points: number(1e3 * points[0].error.value, 1),
                **{
                    f"saved at {factor:g} times the error [%]": partial(_saved_at, factor=factor) for factor in _FACTORS
                },
            },
            list(by_place.items()),
            "The most that a weight saves at which every run arrives and the mean position RMSE is no more than that, "
            "with the bootstrap interval over seeds, 95 %, and in the last brackets the weight [1/W].",
        )
        table = Table.of(
            "Energy against error",
            ("floor", "path"),
            {
                "weight [1/W]": lambda row: f"{row.weight:g}",
                "energy [J]": lambda row: number(row.energy.value, 1),
                "saved [%]": lambda row: _interval(row.saved, 100.0, 1),
                "position RMSE [mm]": lambda row: _interval(row.error, 1e3, 1),
                "across the path, RMSE [mm]": lambda row: number(1e3 * row.lateral.value, 1),
                "arrived": lambda row: f"{row.completed} of {row.of}",
            },
            [((floor, path), point) for (floor, path), points in by_place.items() for point in points],
            "Energy: from the battery, by the true torques of the motors and the robot's drive constants. Saved: over "
            "the same seeds with no weight. In brackets: bootstrap interval over seeds, 95 %.",
        )
        return Report(
            counted=f"{len(results)} runs",
            meta={"plant": self._settings.plant, "weights_per_w": list(self._settings.weights)},
            content={"runs": [vars(result) for result in results]},
            facts=[
                f"{len(results)} runs of '{self._settings.plant}' in {seconds} s, {len(self._settings.seeds)} seeds of "
                "each weight, path and floor."
            ],
            tables=[brief, table],
            figures={"front.png": partial(draw_front, by_place)},
            shown=Shown(
                key_figures=[
                    KeyFigure(
                        "most that is saved", f"{number(100 * best.saved.value, 1)} %", "at less than twice the error"
                    )
                ]
            ),
        )


def _best(points: Sequence[FrontPoint], factor: float) -> FrontPoint:
    """The one that saves most of those that arrived always with no more than `factor` times the error of no weight."""
    most = factor * points[0].error.value
    good = [point for point in points if point.completed == point.of and point.error.value <= most]
    return max(good or points[:1], key=lambda row: row.saved.value)


def _saved_at(points: Sequence[FrontPoint], factor: float) -> str:
    best = _best(points, factor)
    return f"{_interval(best.saved, 100.0, 1)} ({best.weight:g})"


def _interval(of: BootstrapEstimate, scale: float, places: int) -> str:
    value, low, high = (number(scale * part, places) for part in (of.value, of.low, of.high))
    return f"{value} ({low} to {high})"
