"""Experiment that a file describes: variations, parts and tables."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from pandas import DataFrame
from pydantic import Field

from diffdrive_mpc.bench.case import DIMENSIONS, Case, check_count
from diffdrive_mpc.bench.controllers import CONTROLLERS, check_cases, run_case
from diffdrive_mpc.bench.experiment import ExperimentRun, Measure, drive_all, json_rows
from diffdrive_mpc.bench.experiment_file import ExperimentFile, Value, Varied
from diffdrive_mpc.bench.grouped_tables import Cell, TableSpec
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import STATISTICS
from diffdrive_mpc.bench.study import Report, Study, check_parts
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError, load_checked
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.sim import Run

VARIANT = "variant"
"""Name of the column and of the variation that selects one of the variants."""
_DIMENSIONS = {dimension.name for dimension in DIMENSIONS}


class Experiment(ExperimentFile):
    """Experiment with the tables of its report."""

    tables: dict[str, TableSpec] = Field({}, description="tables of the report, in order")

    def drives(self, only: Sequence[str] = ()) -> dict[str, list[ExperimentRun]]:
        """List the runs of each part in `only`, or of all parts if `only` is empty.

        Raise ConfigError for an unknown part, variant or configuration value, ValueError if there are too many runs.
        """
        check_parts(only, tuple(self.parts))
        selected = {name: blocks for name, blocks in self.parts.items() if not only or name in only}
        return {name: [drive for block in blocks for drive in self._block(block)] for name, blocks in selected.items()}

    def _block(self, block: Varied) -> list[ExperimentRun]:
        factors = {name: values for name, values in block.items() if name not in self.vary}
        factors |= {name: block.get(name, values) for name, values in self.vary.items()}
        check_count(math.prod(map(len, factors.values())))
        return [self._drive(dict(zip(factors, values, strict=True))) for values in itertools.product(*factors.values())]

    def _drive(self, values: dict[str, Value]) -> ExperimentRun:
        variant = values.pop(VARIANT, None)
        if variant is not None and variant not in self.variants:
            raise ConfigError(f"variants: there is no {format_unknown_name(str(variant), self.variants)}")
        overrides = {} if variant is None else dict(self.variants[str(variant)])
        overrides |= {name: value for name, value in values.items() if name not in _DIMENSIONS}
        dimensions = {name: value for name, value in values.items() if name in _DIMENSIONS}
        labels = {} if variant is None else {VARIANT: variant}
        return ExperimentRun(Case(**dimensions, overrides=tuple(overrides.items())), labels)  # type: ignore[arg-type]


def load_experiment(file: str | Path) -> Experiment:
    """Read an experiment; raise ConfigError if its file is invalid."""
    return load_checked(Experiment, file)


Drives = dict[str, list[ExperimentRun]]


class SpecStudy(Study[Drives, DataFrame]):
    """Study that runs an experiment; a subclass may add measurements and figures.

    Parameters
    ----------
    experiment
        Experiment with its runs and tables.
    only
        Parts to run; empty for all.
    measure, run_one
        Arguments of `bench.experiment.drive_all`.
    """

    name: ClassVar[str] = "experiment"

    def __init__(
        self,
        experiment: Experiment,
        only: Sequence[str] = (),
        measure: Measure | None = None,
        run_one: Callable[[Case], Run] = run_case,
    ) -> None:
        self.experiment, self._only, self._measure, self._run_one = experiment, only, measure, run_one
        self.title = experiment.title  # type: ignore[misc]

    def plan(self) -> Drives:
        """Plan the runs of each part; raise ConfigError or ValueError if a run is not possible."""
        plan = self.experiment.drives(self._only)
        check_cases(self.reference_cases(plan))
        return plan

    def reference_cases(self, plan: Drives) -> Iterable[Case]:
        """Return the cases whose controller is in `CONTROLLERS`."""
        return (drive.case for drives in plan.values() for drive in drives if drive.case.controller in CONTROLLERS)

    def run(self, plan: Drives, jobs: int, bar: ProgressBar) -> DataFrame:
        """Run every case once; the rows have a column `part`, and a run in several parts has a row in each."""
        drives = {drive.case: drive for part in plan.values() for drive in part}
        bar.start_stage(f"driving, {jobs} at a time", len(drives))
        rows = drive_all(list(drives.values()), jobs, bar.advance, self._measure, self._run_one)
        return stack_parts(rows, plan)

    def tables(self, rows: DataFrame) -> list[Table]:
        """Build the tables of the report."""
        return self.cell_tables(rows, {})

    def cell_tables(self, rows: DataFrame, cells: Mapping[str, Cell]) -> list[Table]:
        """Build the tables of the parts that were run; `cells` are functions that compute further cells, by name."""
        tables = []
        for spec in self.experiment.tables.values():
            part_rows = rows[rows["part"].isin(spec.part)] if spec.part else rows
            if len(part_rows) and (not spec.part or spec.part[0] in set(part_rows["part"])):
                tables.append(spec.table(part_rows.reset_index(drop=True), cells))
        return tables

    def report(self, results: DataFrame, seconds: float) -> Report:
        """Build the report with the tables and every row."""
        rows = results.drop_duplicates("case")
        return Report(
            size=f"{len(rows)} runs",
            meta={"statistics": STATISTICS, "experiment": self.experiment},
            content={"runs": json_rows(rows.drop(columns="part"))},
            facts=[f"{len(rows)} runs in {seconds} s."],
            notes=[f"Errors: {STATISTICS}."],
            tables=self.tables(results),
        )


def stack_parts(rows: DataFrame, plan: Drives) -> DataFrame:
    """Stack the rows of all parts and add the columns `part` and `variant`."""
    indices = {case: index for index, case in enumerate(rows["case"])}
    part_runs = [(name, drive) for name, drives in plan.items() for drive in drives]
    part_rows = rows.iloc[[indices[drive.case] for _, drive in part_runs]].reset_index(drop=True)
    variants = [drive.labels.get(VARIANT, "") for _, drive in part_runs]
    return part_rows.assign(part=[name for name, _ in part_runs], variant=variants)
