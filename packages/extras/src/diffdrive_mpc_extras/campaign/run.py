"""`diffdrive-mpc campaign`: draw the runs of a file, drive them, and write their table."""

from __future__ import annotations

import shutil
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.campaign_file import load_campaign
from diffdrive_mpc_extras.campaign.drive import TIME
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, CampaignRun, drive_all, failed


def write_table(rows: Sequence[Mapping[str, object]], path: Path, facts: Mapping[str, str] | None = None) -> None:
    """Write one row a run, compressed by zstd; missing values of a row are null.

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


RESULTS, CAMPAIGN = "results.parquet", "campaign.yaml"


@dataclass(frozen=True)
class Part:
    """The `number`-th of `of` parts of a campaign, counted from 1: every `of`-th run."""

    number: int = 1
    total: int = 1

    @classmethod
    def read(cls, text: str) -> Part:
        """Read `2/8`; raises ConfigError on anything else."""
        number, slash, total = text.partition("/")
        if not (slash and number.isdecimal() and total.isdecimal() and 1 <= int(number) <= int(total)):
            raise ConfigError(f"--part {text}: give the number of the part and of how many, such as 2/8")
        return cls(int(number), int(total))


def run_campaign(
    file: Path, place: CampaignPlace, runs: int | None = None, part: Part | None = None
) -> list[CampaignRun]:
    """Drive a campaign, print its results, and write the table of its runs into the folder of `place`.

    Parameters
    ----------
    file
        The campaign.
    place
        Store and workers of the runs.
    runs
        Number of runs, in place of that of the file.
    part
        Part of the runs; None for all.

    Raises ConfigError or ValueError if the file has a mistake, and MissingPackageError without pyarrow, before anything
    is driven; StudyFailedError if runs could not be driven.
    """
    needs_arrow()
    chosen = part or Part()
    campaign = load_campaign(file)
    definitions = campaign.definitions(runs)[chosen.number - 1 :: chosen.total]
    if not definitions:
        raise ConfigError(f"--part {chosen.number}/{chosen.total}: the campaign has no run for it; give fewer parts")
    began = time.perf_counter()
    with ProgressBar("preparing") as bar:
        driven = drive_all(definitions, place, bar)
    write_table([run.columns for run in driven], place.folder / RESULTS, {"description": campaign.description})
    copy_of_file = place.folder / CAMPAIGN
    if not (copy_of_file.exists() and copy_of_file.samefile(file)):
        with whole_file(copy_of_file) as draft:
            shutil.copyfile(file, draft)
    console = output_console()
    console.print(_sentence(driven, time.perf_counter() - began), highlight=False, markup=False)
    console.print(f"table in {place.folder / RESULTS}", highlight=False, markup=False)
    if failed(driven):
        console.print(failed(driven), highlight=False, markup=False)
    return driven


def _sentence(driven: list[CampaignRun], seconds: float) -> str:
    done = sum(run.row["completed"] is True for run in driven)
    each = statistics.fmean(run.number(f"{TIME}processor_s") for run in driven)
    return f"{len(driven)} runs, {done} completed; {each:.2f} s of one core for each; {seconds:.0f} s this time"
