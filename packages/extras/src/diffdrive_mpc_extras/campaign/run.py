"""`diffdrive-mpc campaign`: draw the runs of a campaign file, simulate them, and write a table of results."""

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
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, CampaignRun, describe_errors, drive_all


def write_table(rows: Sequence[Mapping[str, object]], path: Path, facts: Mapping[str, str] | None = None) -> None:
    """Write one row per run to a Parquet file, compressed by zstd; missing values are null.

    Equal rows give equal columns in equal order. A column of integers and floating-point numbers becomes floating
    point; a column of texts and numbers becomes text. `facts` are stored as metadata of the schema.

    Raises MissingPackageError if pyarrow is missing, and ConfigError if `path` cannot be written.
    """
    arrow, parquet = import_arrow()
    names = list(dict.fromkeys(name for row in rows for name in row))
    # The columns of time are last, because readers omit them together.
    names.sort(key=lambda name: name.startswith(TIME))
    columns = [_column([row.get(name) for row in rows], arrow) for name in names]
    table = arrow.table(columns, names=names).replace_schema_metadata(dict(facts or {}))
    with whole_file(path) as draft:
        parquet.write_table(table, draft, compression="zstd")


def read_table(path: Path, *, times: bool = True) -> Any:  # noqa: ANN401 - a pyarrow.Table
    """Read a table of `write_table`, with or without the columns of time.

    Raises MissingPackageError if pyarrow is missing.
    """
    _, parquet = import_arrow()
    # Reading by path would open the file twice, and another campaign may replace it in between.
    with path.open("rb") as file:
        table = parquet.read_table(file)
    return table if times else table.select([name for name in table.column_names if not name.startswith(TIME)])


def _column(values: list[object], arrow: Any) -> Any:  # noqa: ANN401 - pyarrow has no types
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {bool}:
        # A column without values becomes a column of unknown numbers.
        return arrow.array(values, type=arrow.bool_() if kinds else arrow.float64())
    if kinds == {int}:
        return arrow.array(values, type=arrow.int64())
    if kinds <= {int, float}:
        return arrow.array([None if value is None else float(value) for value in values], type=arrow.float64())  # type: ignore[arg-type]
    return arrow.array([None if value is None else str(value) for value in values], type=arrow.string())


def import_arrow() -> tuple[Any, Any]:
    """Import and return pyarrow and pyarrow.parquet; raises MissingPackageError if it is not installed."""
    try:
        import pyarrow  # noqa: PLC0415 - optional
        import pyarrow.parquet  # noqa: PLC0415
    except ImportError as error:
        raise MissingPackageError("results as Parquet need pyarrow: pip install diffdrive-mpc[campaign]") from error
    return pyarrow, pyarrow.parquet


RESULTS, CAMPAIGN = "results.parquet", "campaign.yaml"


@dataclass(frozen=True)
class Part:
    """Part of a campaign: every `total`-th run from run `number` on, counted from 1."""

    number: int = 1
    total: int = 1

    @classmethod
    def read(cls, text: str) -> Part:
        """Parse a text such as `2/8`; raises ConfigError for any other format."""
        number, slash, total = text.partition("/")
        if not (slash and number.isdecimal() and total.isdecimal() and 1 <= int(number) <= int(total)):
            raise ConfigError(f"--part {text}: give the number of the part and the number of parts, such as 2/8")
        return cls(int(number), int(total))


def run_campaign(
    file: Path, place: CampaignPlace, runs: int | None = None, part: Part | None = None
) -> list[CampaignRun]:
    """Simulate a campaign, print its results, and write the table of its runs into the folder of `place`.

    Parameters
    ----------
    file
        Campaign file.
    place
        Store and workers of the runs.
    runs
        Number of runs; None for the number in the file.
    part
        Part of the runs; None for all runs.

    Raises ConfigError or ValueError if the file is invalid, and MissingPackageError if pyarrow is missing, both before
    the first run; raises StudyFailedError if a run fails.
    """
    import_arrow()
    selection = part or Part()
    campaign = load_campaign(file)
    definitions = campaign.definitions(runs)[selection.number - 1 :: selection.total]
    if not definitions:
        raise ConfigError(f"---part {selection.number}/{selection.total}: this part has no runs; give fewer parts")
    start = time.perf_counter()
    with ProgressBar("preparing") as bar:
        results = drive_all(definitions, place, bar)
    write_table([run.columns for run in results], place.folder / RESULTS, {"description": campaign.description})
    copy_of_file = place.folder / CAMPAIGN
    if not (copy_of_file.exists() and copy_of_file.samefile(file)):
        with whole_file(copy_of_file) as draft:
            shutil.copyfile(file, draft)
    console = output_console()
    console.print(_summary(results, time.perf_counter() - start), highlight=False, markup=False)
    console.print(f"table in {place.folder / RESULTS}", highlight=False, markup=False)
    if describe_errors(results):
        console.print(describe_errors(results), highlight=False, markup=False)
    return results


def _summary(results: list[CampaignRun], seconds: float) -> str:
    completed = sum(run.row["completed"] is True for run in results)
    mean_time = statistics.fmean(run.number(f"{TIME}processor_s") for run in results)
    return (
        f"{len(results)} runs, {completed} completed; {mean_time:.2f} s of one core per run; {seconds:.0f} s in total"
    )
