"""Schema of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel

Value = bool | int | float | str
Varied = dict[str, Annotated[tuple[Value, ...], Field(min_length=1)]]
"""Values by dimension: a field of `bench.case.Case`, a configuration value by dotted key, or `variant`."""


class TableFile(StrictModel):
    """Table over groups of runs; a cell whose definition is one word is computed by the program."""

    title: str
    part: tuple[str, ...] = Field((), description="parts of the experiment in the table; empty for all runs")
    where: dict[str, Value] = Field({}, description="value of each column that a run must have to be in the table")
    by: Annotated[dict[str, str], Field(min_length=1)] = Field(description="grouping columns by heading")
    columns: dict[str, str] = Field(description="definitions of the cells, by heading of the column")
    across: str = Field(
        "", description="column; the cells are repeated for each of its values, which replaces {} in the headings"
    )
    mean: bool = Field(False, description="true to add a row of means after each block of rows")
    note: str = ""


class ExperimentFile(StrictModel):
    """Runs of an experiment and tables of their results."""

    title: str = Field(description="heading of the report")
    vary: Varied = Field({}, description="default values of the dimensions; the last dimension varies fastest")
    variants: dict[str, dict[str, Value]] = Field({}, description="configuration values by name of the variant")
    parts: dict[str, tuple[Varied, ...]] = Field(description="blocks of each part; all combinations of a block are run")
    tables: Mapping[str, TableFile] = Field({}, description="tables of the report, in order")
