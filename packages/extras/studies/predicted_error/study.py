"""Study of the predicted error: calibration, coverage and width of the tubes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import yaml
from studies.predicted_error.calibrate import DIRECTIONS, calibrate_scale, coverage, oracle_widths
from studies.predicted_error.drives import (
    DrivenPath,
    PlannedDrive,
    PredictedErrorFile,
    drive,
    planned_sets,
    read_drives,
    write_drives,
)

from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, millis, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_extras.predicted_error.calibration import ErrorCalibration, ErrorPopulation

CALIBRATION = "calibration.yaml"
Driven = Mapping[str, Sequence[DrivenPath]]
_HEAD = """\
# Written by `make study NAME=predicted-error`; packages/extras/studies/predicted_error/study.yaml has drives and seeds.
# The scale of |error| is the sum of the features (calibration.py) times these coefficients [m per unit], fitted as the
# quantile `level`; a tube is a multiple of the scale. The multiples are conformal quantiles over robots, paths and
# seeds that the fit did not use: at_each_place weighs all drives equally, everywhere counts whole drives.
# `calibrated` has the ranges of the calibration with some margin: maximum speed v [m/s] and yaw rate omega [rad/s] of
# the paths, and lag of the models, dead time included [s].
"""
_COLUMNS = (
    "drives",
    "direction",
    "count",
    "at each place [%]",
    "everywhere [%]",
    "95 % interval",
    "width [mm]",
    "width everywhere [mm]",
)


class PredictedErrorStudy(Study[dict[str, list[PlannedDrive]], Driven]):
    """Study with drives of several populations for fit, calibration, test and reference tubes.

    Parameters
    ----------
    study
        Content of the study file.
    store
        Folder of stored sets of drives, read and written; None to simulate all drives.
    """

    name, title = "predicted-error", "Predicted tracking error"

    def __init__(self, study: PredictedErrorFile, store: Path | None = None) -> None:
        self._study, self._store = study, store

    def plan(self) -> dict[str, list[PlannedDrive]]:
        """Plan all sets of drives; raises ConfigError for an unknown factor."""
        return planned_sets(self._study)

    def run(self, plan: dict[str, list[PlannedDrive]], jobs: int, bar: ProgressBar) -> Driven:
        """Simulate every set that is not stored."""
        driven: dict[str, Sequence[DrivenPath]] = {}
        for name, drives in plan.items():
            file = None if self._store is None else self._store / f"{name}.npz"
            if file is not None and file.exists():
                driven[name] = read_drives(file)
                if len(driven[name]) != len(drives):
                    raise ConfigError(f"{file}: {len(driven[name])} drives instead of {len(drives)}; remove the file")
                continue
            bar.start_stage(f"driving {name}", len(drives))
            driven[name] = run_tasks(
                [partial(drive, self._study, planned_drive) for planned_drive in drives], jobs, bar.advance
            )
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                write_drives(driven[name], file)
        return driven

    def report(self, results: Driven, seconds: float) -> Report:  # noqa: ARG002 - interface
        """Report the calibration, coverage by set and class, and widths compared with reference tubes."""
        level = self._study.level
        populations = {
            name: ErrorPopulation(
                description=population.description,
                drives={"fit": len(results[f"{name}-fit"]), "calibration": len(results[f"{name}-calibration"])},
                **{
                    direction: calibrate_scale(results[f"{name}-fit"], results[f"{name}-calibration"], direction, level)
                    for direction in DIRECTIONS
                },
            )
            for name, population in self._study.populations.items()
        }
        calibration = ErrorCalibration(
            level=level,
            provenance="studies/predicted_error; plants and configurations are those of its file",
            calibrated=self._study.calibrated_ranges,
            populations=populations,
        )
        tables = [
            self._coverage(results, calibration),
            self._classes(results, calibration),
            self._others(results, calibration),
            self._oracle(results, calibration),
        ]
        text = _HEAD + yaml.safe_dump(calibration.model_dump(), sort_keys=False, width=150, default_flow_style=None)
        total = sum(map(len, results.values()))
        return Report(
            size=f"{total} drives",
            meta={"level": level},
            content={
                table.title: [dict(zip(table.columns, row, strict=True)) for row in table.rows] for table in tables
            },
            facts=[
                "Coefficients, quantiles and test come from robots, paths and seeds apart from each other.",
                "At each place: mean over drives of the share of places inside. Everywhere: drives that are inside all "
                "the way, with the exact interval. Widths are to either side.",
            ],
            tables=[table for table in tables if table.rows],
            files={CALIBRATION: text},
        )

    def _coverage(self, results: Driven, calibration: ErrorCalibration) -> Table:
        rows = [
            row for name in calibration.populations for row in _rows(name, name, results[f"{name}-test"], calibration)
        ]
        return Table("Coverage on unseen drives", _COLUMNS, tuple(rows), text_columns=2)

    def _classes(self, results: Driven, calibration: ErrorCalibration) -> Table:
        rows = []
        for name in calibration.populations:
            driven = results[f"{name}-test"]
            for description, is_member in _CLASSES:
                members = [path for path in driven if is_member(path)]
                rows += _rows(f"{name}, {description}", name, members, calibration) if members else []
        return Table("Coverage by class", _COLUMNS, tuple(rows), text_columns=2)

    def _others(self, results: Driven, calibration: ErrorCalibration) -> Table:
        rows = [
            row
            for kind in self._study.others
            for name in calibration.populations
            for row in _rows(f"{kind}, by {name}", name, results[kind], calibration)
        ]
        return Table("Coverage on other kinds", _COLUMNS, tuple(rows), text_columns=2)

    def _oracle(self, results: Driven, calibration: ErrorCalibration) -> Table:
        rows, oracle = [], self._study.oracle
        for name, population in calibration.populations.items():
            for seed, direction in itertools.product(oracle.paths, DIRECTIONS):
                driven = results[f"{name}-oracle-{seed}"]
                tubes = coverage(driven, getattr(population, direction), direction)
                widths = oracle_widths(driven, direction, calibration.level)
                ratios = [number(tubes.width / widths[0], 2), number(tubes.width_everywhere / widths[1], 2)]
                rows.append((name, f"spline-{seed}", direction, *ratios, *map(millis, widths)))
        columns = ("population", "path", "direction", "ratio", "everywhere", "oracle [mm]", "everywhere [mm]")
        note = f"Width over that of the quantiles of {oracle.drives} drives of the path with robots of the population."
        return Table("Width beside an oracle", columns, tuple(rows), text_columns=3, note=note)


_CLASSES: tuple[tuple[str, Callable[[DrivenPath], bool]], ...] = (
    ("below 0.3 m/s", lambda path: path.speed < 0.3),
    ("0.3 to 0.45 m/s", lambda path: 0.3 <= path.speed < 0.45),
    ("from 0.45 m/s", lambda path: path.speed >= 0.45),
    ("friction below 0.4", lambda path: path.friction < 0.4),
    ("friction 0.4 to 0.7", lambda path: 0.4 <= path.friction < 0.7),
    ("friction from 0.7", lambda path: path.friction >= 0.7),
)


def _rows(
    label: str, population: str, driven: Sequence[DrivenPath], calibration: ErrorCalibration
) -> list[tuple[str, ...]]:
    rows = []
    for direction in DIRECTIONS:
        result = coverage(driven, getattr(calibration.populations[population], direction), direction)
        rate = result.everywhere
        shares = [number(100 * result.at_each_place, 1), number(100 * rate.share, 1)]
        interval = f"{100 * rate.low:.1f} to {100 * rate.high:.1f}"
        rows.append(
            (label, direction, str(rate.of), *shares, interval, millis(result.width), millis(result.width_everywhere))
        )
    return rows
