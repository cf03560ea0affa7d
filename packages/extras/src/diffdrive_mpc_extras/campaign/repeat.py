"""Command `diffdrive-mpc repeat`: repeat the run of a file and compare its values with the file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import yaml
from pydantic import Field

from diffdrive_mpc.app.run_log import includes_plans, run_log
from diffdrive_mpc.app.simulate.single import draw, report
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import REPORT, page_in, staged
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.trust import only_trusted
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.definition import Definition, environment, key_of
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.drive import TIME, Row, drive_run
from diffdrive_mpc_extras.campaign.engine import CampaignRun

_HEAD = "# A run: drive it again with `diffdrive-mpc repeat FILE`. Units are those of the files and options.\n"


class RunFile(StrictModel):
    """Content of a run file."""

    run: str = Field(description="hash of the run")
    factors: dict[str, Value] = Field(description="definition of the run; omitted values are defaults")
    figures: dict[str, bool | int | float | str | None] = Field(description="row of the run, without times")
    environment: dict[str, str] = Field(description="product, libraries and machine of the run")

    @property
    def definition(self) -> Definition:
        """Definition of the run."""
        return Definition.from_factors(self.factors)


def write_run(run: CampaignRun, path: Path) -> None:
    """Write a run file; raises ConfigError if `path` cannot be written."""
    defaults = Definition.from_factors({}).factors
    factors = {
        name: value
        for name, value in run.definition.factors.items()
        if value is not None and (name not in defaults or value != defaults[name] or name == "seed")
    }
    figures = {name: value for name, value in run.row.items() if not name.startswith(TIME)}
    data = {"run": run.key, "factors": factors, "figures": figures, "environment": environment()}
    with whole_file(path) as draft:
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=120)
        draft.write_text(_HEAD + text, encoding="utf-8")


def load_run(path: str | Path) -> RunFile:
    """Read a run file; raises ConfigError if it is invalid."""
    return load_checked(RunFile, path)


def compare(stored: RunFile, row: Row) -> tuple[bool, str]:
    """Compare the values of a row with the file; return True if they are equal, and a sentence about the result."""
    values = {name: value for name, value in row.items() if not name.startswith(TIME)}
    differing = [name for name in stored.figures if stored.figures[name] != values.get(name)]
    if not differing:
        return True, f"all {len(stored.figures)} values are identical to the file"
    name = differing[0]
    first = f"{name} is {values.get(name)}, was {stored.figures[name]}"
    return False, f"{len(differing)} of {len(stored.figures)} values differ: {first}; {_cause(stored)}"


def _cause(stored: RunFile) -> str:
    current = environment()
    changed = [name for name, value in stored.environment.items() if current.get(name) != value]
    if changed:
        changes = ", ".join(
            f"{name} ({_shorten(stored.environment[name])}, now {_shorten(current.get(name, '-'))})" for name in changed
        )
        return f"changed: {changes}"
    if key_of(stored.definition) != stored.run:
        return "a file of the run has changed"
    return "product, libraries and files are equal; the processor may differ"


def _shorten(text: str) -> str:
    return text[:12]


def repeat_run(
    file: Path,
    out: Path | None = None,
    log: Path | None = None,
    trusted: Sequence[Path] = (),
    *,
    details: bool = False,
) -> bool:
    """Repeat the run of `file`; print a summary or, with `details`, its tables; write `out` and `log` if given.

    Returns True if all values are equal.

    Raises ConfigError or ValueError if the file or a file of the run is invalid, or if such a file is neither shipped
    nor in a folder of `trusted`.
    """
    with only_trusted(file, trusted):
        return _repeat_run(file, out, log, details)


def _repeat_run(file: Path, out: Path | None, log: Path | None, details: bool) -> bool:
    stored = load_run(file)
    definition = stored.definition
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        folder = None if out is None else stack.enter_context(staged(out, (REPORT,), owner="repeat"))
        start = time.perf_counter()
        with ProgressBar("simulating") as bar:
            run, row = drive_run(definition, bar.show, keep_plans=folder is not None or includes_plans(log))
        if run is not None:
            write_log(run, definition.case, ["repeat", str(file)])
        if run is not None and folder is not None:
            draw(RunOutcome(definition.case, run), folder, time.perf_counter() - start)
    console = output_console()
    if run is not None:
        report(RunOutcome(definition.case, run), out and page_in(out, "repeat"), details=details)
    else:
        console.print(f"not completed: {row['error']}", markup=False, highlight=False)
    is_equal, sentence = compare(stored, row)
    console.print(f"{file}: {sentence}", markup=False, highlight=False)
    return is_equal
