"""`diffdrive-mpc repeat`: drive the run of a file again and compare its figures with those of the file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from diffdrive_mpc.app.run_log import holds_plans, run_log
from diffdrive_mpc.app.simulate.single import draw, report
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.bench.run_row import RunOutcome
from diffdrive_mpc.models.trust import only_trusted
from diffdrive_mpc_extras.campaign.drive import drive_whole
from diffdrive_mpc_extras.campaign.run_file import compared, load_run


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
            run, row = drive_whole(definition, bar.at, keep_plans=folder is not None or holds_plans(log))
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
