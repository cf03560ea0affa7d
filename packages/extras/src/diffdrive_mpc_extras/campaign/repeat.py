"""`diffdrive-mpc repeat`: drive the run of a file again and compare its figures with those of the file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import yaml
from pydantic import Field

from diffdrive_mpc.app.run_log import holds_plans, run_log
from diffdrive_mpc.app.simulate.single import draw, report
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.trust import only_trusted
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc_extras.campaign.definition import Definition, environment, key_of
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.drive import TIME, Row, drive_whole
from diffdrive_mpc_extras.campaign.engine import CampaignRun

_HEAD = "# A run: drive it again with `diffdrive-mpc repeat FILE`. Units are those of the files and options.\n"


class RunFile(StrictModel):
    """Content of the file of a run."""

    run: str = Field(description="hash of the run")
    factors: dict[str, Value] = Field(description="what defines it; what is left out has its default")
    figures: dict[str, bool | int | float | str | None] = Field(description="its row, without times")
    environment: dict[str, str] = Field(description="product, libraries and machine that it was driven on")

    @property
    def definition(self) -> Definition:
        """The run."""
        return Definition.from_factors(self.factors)


def write_run(driven: CampaignRun, path: Path) -> None:
    """Write a run; raises ConfigError if `path` cannot be written to."""
    usual = Definition.from_factors({}).factors
    factors = {
        name: value
        for name, value in driven.definition.factors.items()
        if value is not None and (name not in usual or value != usual[name] or name == "seed")
    }
    figures = {name: value for name, value in driven.row.items() if not name.startswith(TIME)}
    data = {"run": driven.key, "factors": factors, "figures": figures, "environment": environment()}
    with whole_file(path) as draft:
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=120)
        draft.write_text(_HEAD + text, encoding="utf-8")


def load_run(path: str | Path) -> RunFile:
    """Read a run; raises ConfigError when the file has a mistake."""
    return load_checked(RunFile, path)


def compared(stored: RunFile, row: Row) -> tuple[bool, str]:
    """Compare the figures of a row with those of the file; return the result and a sentence about it."""
    again = {name: value for name, value in row.items() if not name.startswith(TIME)}
    differing = [name for name in stored.figures if stored.figures[name] != again.get(name)]
    if not differing:
        return True, f"all {len(stored.figures)} figures are those of the file, to the last bit"
    name = differing[0]
    first = f"{name} is {again.get(name)}, was {stored.figures[name]}"
    return False, f"{len(differing)} of {len(stored.figures)} figures are other ones: {first}; {_why(stored)}"


def _why(stored: RunFile) -> str:
    now = environment()
    changed = [name for name, value in stored.environment.items() if now.get(name) != value]
    if changed:
        was = ", ".join(
            f"{name} ({_brief(stored.environment[name])}, now {_brief(now.get(name, '-'))})" for name in changed
        )
        return f"other than then: {was}"
    if key_of(stored.definition) != stored.run:
        return "a file that it names has changed"
    return "product, libraries and files are the same: is the processor of another kind?"


def _brief(text: str) -> str:
    return text[:12]


def repeat_run(
    file: Path,
    out: Path | None = None,
    log: Path | None = None,
    trusted: Sequence[Path] = (),
    *,
    details: bool = False,
) -> bool:
    """Drive the run of `file`; print a summary, or with `details` its tables; write figures and log where asked.

    Return True if all figures are the same.

    Raises ConfigError or ValueError if the file or one that it names cannot be used, or does not ship and lies in none
    of the folders `trusted`.
    """
    with only_trusted(file, trusted):
        return _drive_again(file, out, log, details)


def _drive_again(file: Path, out: Path | None, log: Path | None, details: bool) -> bool:
    stored = load_run(file)
    definition = stored.definition
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        folder = None if out is None else stack.enter_context(staged(out, owner="repeat"))
        began = time.perf_counter()
        with ProgressBar("simulating") as bar:
            run, row = drive_whole(definition, bar.show, keep_plans=folder is not None or holds_plans(log))
        if run is not None:
            write_log(run, definition.case, ["repeat", str(file)])
        if run is not None and folder is not None:
            draw(RunOutcome(definition.case, run), folder, time.perf_counter() - began)
    console = output_console()
    if run is not None:
        report(RunOutcome(definition.case, run), out, details=details)
    else:
        console.print(f"not completed: {row['error']}", markup=False, highlight=False)
    same, sentence = compared(stored, row)
    console.print(f"{file}: {sentence}", markup=False, highlight=False)
    return same
