"""`python -m studies predicted-error`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.command_line.options import Jobs, file_option, out_option

EXAMPLE = "Example: python -m studies predicted-error --out predicted --quick"


def run(
    *,
    out: Annotated[Path, out_option("report.html, predicted-error.json, predicted-error.md and calibration.yaml")],
    quick: Annotated[bool, typer.Option("--quick", help="Few drives of one population.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            "--kept", metavar="FOLDER", help="Folder for driven sets, which a later run reads.", show_default=False
        ),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Calibrate the predicted tracking error, and measure its coverage on other drives: a quarter of an hour."""
    from studies.predicted_error.drives import load_study  # noqa: PLC0415
    from studies.predicted_error.study import PredictedErrorStudy  # noqa: PLC0415

    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does not need it

    if quick and (study is not None or store is not None):
        raise ValueError("--quick has a study of its own and keeps nothing; give it alone")
    carry_out(PredictedErrorStudy(load_study(study, quick=quick), store), out, jobs)
