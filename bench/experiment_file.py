"""Schema of an experiment file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import Field

from diffdrive_mpc.models.checked_yaml import StrictModel

Value = bool | int | float | str
Varied = dict[str, Annotated[tuple[Value, ...], Field(min_length=1)]]
"""Values of dimensions of `bench.case.Case`, of configuration values by dotted key, and of `variant`."""


class TableFile(StrictModel):
    """A table over groups of runs; cells that the program computes have a name of one word."""

    title: str
    part: tuple[str, ...] = Field((), description="parts of the experiment to tabulate; empty for all runs")
    where: dict[str, Value] = Field({}, description="required value by column; selects the runs")
    by: Annotated[dict[str, str], Field(min_length=1)] = Field(description="columns to group by, under their headings")
    columns: dict[str, str] = Field(description="definition of the cells, by the heading of their column")
    across: str = Field(
        "", description="column for whose values the columns are repeated; the value replaces {} in headings"
    )
    mean: bool = Field(False, description="whether a row below each block summarises the block")
    note: str = ""


class ExperimentFile(StrictModel):
    """Runs of an experiment and their presentation."""

    title: str = Field(description="heading of the report")
    vary: Varied = Field({}, description="values for every part that does not define them; the last varies fastest")
    variants: dict[str, dict[str, Value]] = Field({}, description="configuration values under the name of a variant")
    parts: dict[str, tuple[Varied, ...]] = Field(description="blocks of each part; combinations of values are run")
    tables: Mapping[str, TableFile] = Field({}, description="tables of the report, in order")
