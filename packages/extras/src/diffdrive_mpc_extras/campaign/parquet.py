"""Rows of runs as one Parquet file, which pandas, polars and DuckDB read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.drive import TIME


def write_table(rows: Sequence[Mapping[str, object]], path: Path, facts: Mapping[str, str] | None = None) -> None:
    """Write one row a run, compressed by zstd; what a row lacks is null.

    The same rows give the same columns in the same order. Whole numbers and others in one column become floating-point
    numbers, texts and numbers texts. `facts` are kept as metadata of the file's schema.

    Raises MissingPackageError without pyarrow, ConfigError if `path` cannot be written to.
    """
    arrow, parquet = needs_arrow()
    names = list(dict.fromkeys(name for row in rows for name in row))
    # Times last: they are left out together.
    names.sort(key=lambda name: name.startswith(TIME))
    columns = [_column([row.get(name) for row in rows], arrow) for name in names]
    table = arrow.table(columns, names=names).replace_schema_metadata(dict(facts or {}))
    with whole_file(path) as draft:
        parquet.write_table(table, draft, compression="zstd")


def read_table(path: Path, *, times: bool = True) -> Any:  # noqa: ANN401 - a pyarrow.Table
    """Read such a file, with or without the columns of time; raises MissingPackageError without pyarrow."""
    _, parquet = needs_arrow()
    # From one handle: a path is opened twice, and another campaign may replace the file meanwhile.
    with path.open("rb") as file:
        table = parquet.read_table(file)
    return table if times else table.select([name for name in table.column_names if not name.startswith(TIME)])


def _column(values: list[object], arrow: Any) -> Any:  # noqa: ANN401 - pyarrow has no types
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool}:
        # Nothing at all is a number that is not known.
        return arrow.array(values, type=arrow.bool_() if kinds else arrow.float64())
    if kinds == {int}:
        return arrow.array(values, type=arrow.int64())
    if kinds <= {int, float}:
        return arrow.array([None if value is None else float(value) for value in values], type=arrow.float64())  # type: ignore[arg-type]
    return arrow.array([None if value is None else str(value) for value in values], type=arrow.string())


def needs_arrow() -> tuple[Any, Any]:
    """Give pyarrow and its part for Parquet; raises MissingPackageError where it is not installed."""
    try:
        import pyarrow  # noqa: PLC0415 - optional
        import pyarrow.parquet  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError("results as Parquet need pyarrow: pip install diffdrive-mpc[campaign]") from error
    return pyarrow, pyarrow.parquet
