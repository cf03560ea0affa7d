"""The table in a file of a log: CSV, or Parquet where pyarrow is installed."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.input_file import open_input
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import csv_table
from diffdrive_mpc.models.logs.bag_bounds import Budget
from diffdrive_mpc.models.logs.csv_table import CsvTable, Growing, as_numbers

_MAGIC = b"PAR1"
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def read_header(path: Path) -> list[str]:
    """Names of the columns; raises ConfigError as `read_table`."""
    if not _is_parquet(path):
        return csv_table.read_header(path)
    with _parquet(path) as file:
        return list(file.schema_arrow.names)


def read_table(path: Path, names: Collection[str]) -> CsvTable:
    """Read columns of a CSV or Parquet file; times and durations of Parquet become seconds.

    Raises
    ------
    ConfigError
        As `csv_table.read_table`; of Parquet also without pyarrow, or where a column holds neither numbers nor words.
    """
    if not _is_parquet(path):
        return csv_table.read_table(path, names)
    with _parquet(path, names) as file:
        header = list(file.schema_arrow.names)
        wanted = [name for name in header if name in names]
        values: dict[str, Growing[np.float64]] = {name: Growing(np.float64) for name in wanted}
        empty: dict[str, Growing[np.bool_]] = {name: Growing(np.bool_) for name in wanted}
        words: dict[str, float] = {}
        count = file.metadata.num_rows
        Budget(path, path.stat().st_size, "convert it to CSV").take(8 * count * len(wanted) + _unpacked(file, wanted))
        for batch in file.iter_batches(columns=wanted):
            for name in wanted:
                column = batch.column(name)
                values[name].extend(_numbers(path, name, column, words))
                empty[name].extend(column.is_null().to_numpy(zero_copy_only=False))
    if not count:
        raise ConfigError(f"{path}: no rows; a log has a row of numbers per sample")
    missing = {name: column.array() for name, column in empty.items()}
    cells = {name: column.array() for name, column in values.items()}
    return CsvTable(path, header, np.arange(count), np.arange(1, count + 1), cells, missing, words)


def _is_parquet(path: Path) -> bool:
    try:
        with open_input(path) as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False  # the reader of CSV says what is wrong


@contextmanager
def _parquet(path: Path, names: Collection[str] = ()) -> Iterator[Any]:
    """A `pyarrow.parquet.ParquetFile`; raises ConfigError where it cannot be read, here or in the context.

    Words in the columns `names` stay a dictionary where the file has one: each is read once, not once a row.
    """
    try:
        from pyarrow import ArrowException  # noqa: PLC0415 - only who reads such files needs it
        from pyarrow.parquet import ParquetFile  # noqa: PLC0415
    except ImportError as error:
        convert = f"import pandas; pandas.read_parquet('{path.name}').to_csv('{path.stem}.csv')"
        raise ConfigError(
            f'{path}: a Parquet file needs pyarrow: `pip install pyarrow`, or where it is `python -c "{convert}"`'
        ) from error
    try:
        with open_input(path) as file, ParquetFile(file) as parquet:
            columns = {parquet.schema.column(index).path for index in range(len(parquet.schema))}
            yield ParquetFile(file, metadata=parquet.metadata, read_dictionary=sorted(columns & set(names)))
    except (ArrowException, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as Parquet ({' '.join(str(error).split())})") from error


def _unpacked(file: Any, names: Collection[str]) -> int:  # noqa: ANN401 - pyarrow has no types
    """Bytes to which the columns of a Parquet file unpack, as its directory states them."""
    groups = [file.metadata.row_group(index) for index in range(file.metadata.num_row_groups)]
    chunks = [group.column(index) for group in groups for index in range(group.num_columns)]
    return sum(chunk.total_uncompressed_size for chunk in chunks if chunk.path_in_schema in names)


def _numbers(path: Path, name: str, column: Any, words: dict[str, float]) -> FloatArray:  # noqa: ANN401
    """A column (n,) as numbers, NaN where it is null; words as `as_numbers`."""
    import pyarrow  # noqa: PLC0415

    types, factor = pyarrow.types, 1.0
    if types.is_dictionary(column.type):
        # A word that every row names stands once in the file, and is not copied for each.
        of_word = np.append(_numbers(path, name, column.dictionary, words), np.nan)
        rows = column.indices.fill_null(len(of_word) - 1).to_numpy(zero_copy_only=False)
        return np.asarray(of_word[rows])
    kind = column.type
    if types.is_string(kind) or types.is_large_string(kind):
        return as_numbers([(cell or "").strip() for cell in column.to_pylist()], words)
    if types.is_timestamp(kind) or types.is_duration(kind):
        column, factor = column.cast(pyarrow.int64()), _SECONDS[kind.unit]
    elif types.is_boolean(kind):
        column = column.cast(pyarrow.int8())
    elif not (types.is_integer(kind) or types.is_floating(kind) or types.is_decimal(kind)):
        raise ConfigError(f"{path}: column '{name}' holds {kind}; give it as numbers or words, one a row")
    numbers = column.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(factor * numbers)
