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
            "--kept", metavar="FOLDER", help="Folder of stored sets of drives, read and written.", show_default=False
        ),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Calibrate the predicted tracking error, and measure its coverage on other drives; about 15 minutes."""
    from studies.predicted_error.drives import load_study  # noqa: PLC0415
    from studies.predicted_error.study import PredictedErrorStudy  # noqa: PLC0415

    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415 - --help does not need it

    if quick and (study is not None or store is not None):
        raise ValueError("--quick cannot be combined with --study or --kept; remove one of them")
    carry_out(PredictedErrorStudy(load_study(study, quick=quick), store), out, jobs)
