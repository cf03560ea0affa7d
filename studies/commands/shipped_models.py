"""`python -m studies models`: what ships found again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

shipped_models_app = typer.Typer(
    no_args_is_help=True, help="Find the shipped models and the simulated robot's firmware again."
)


@shipped_models_app.command(epilog="Example: python -m studies models fit --out my_models")
def fit(
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for mbm.yaml and sm.yaml; by default the shipped ones.", show_default=False),
    ] = None,
) -> None:
    """Identify MBM and SM again, from the papers' experiments run on the simulated robot."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.models.load import PARAMETERS  # noqa: PLC0415
    from studies.shipped_models.model_fitting import fit_models  # noqa: PLC0415

    with ProgressBar("experiments and identification (about a minute)") as bar:
        table, warnings = fit_models(out or PARAMETERS, on_progress=bar.at)
    output_console().print(table.rich())
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)


@shipped_models_app.command(epilog="Example: python -m studies models drives --out my_models")
def drives(
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for p2_experimental.yaml and p2_physical.yaml; by default the shipped ones.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Fit the drive models again, on drives of the simulated robot with changes of direction."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.models.load import PARAMETERS  # noqa: PLC0415
    from studies.shipped_models.model_fitting import fit_drives  # noqa: PLC0415

    folder = out or PARAMETERS
    folder.mkdir(parents=True, exist_ok=True)
    with ProgressBar("drives and fits (about a minute)"):
        table = fit_drives(folder)
    output_console().print(table.rich())


@shipped_models_app.command(epilog="Example: python -m studies models train --out my_models")
def train(
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for lstm.yaml and lstm.npz; by default the shipped ones.", show_default=False),
    ] = None,
) -> None:
    """Train the network again, on a five-minute drive of the simulated robot; needs the extra `learn`."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.models.load import PARAMETERS  # noqa: PLC0415
    from studies.shipped_models.model_fitting import fit_network  # noqa: PLC0415

    folder = out or PARAMETERS
    folder.mkdir(parents=True, exist_ok=True)
    with ProgressBar("drives and training (about a minute)") as bar:
        table = fit_network(folder, on_progress=bar.at)
    output_console().print(table.rich())


@shipped_models_app.command(epilog="Example: python -m studies models calibrate --out my_firmware.yaml")
def calibrate(
    out: Annotated[
        Path | None, typer.Option(help="Parameter file to write; by default the shipped one.", show_default=False)
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Only report how well the shipped calibration predicts drives held out from it, and prove that no "
            "neighbour of its values fits better.",
        ),
    ] = False,
) -> None:
    """Fit the simulated robot's firmware so that the published SSM predicts what it measures."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.sim.plants.twin_parameters import FIRMWARE_FILE, load_firmware  # noqa: PLC0415
    from studies.shipped_models.calibration import calibrate as fit_firmware  # noqa: PLC0415
    from studies.shipped_models.calibration import (  # noqa: PLC0415
        calibration_table,
        neighbour_errors,
        neighbours_table,
    )

    if check and out is not None:
        raise ValueError(f"--out {out}: --check writes nothing; give one of them")
    around: dict[str, tuple[float, ...]] = {}
    if check:
        firmware, around = load_firmware(), neighbour_errors()
        output_console().print(neighbours_table(around).rich())
    else:
        with ProgressBar("calibration (a few minutes), parameters tried:") as bar:
            firmware = fit_firmware(out or FIRMWARE_FILE, on_evaluation=bar.advance)
    output_console().print(calibration_table(firmware).rich())
    better = [name for name, errors in around.items() if min(errors) <= 1.0]
    if better:
        raise ValueError(f"firmware.yaml: another value of {', '.join(better)} fits better: run make calibrate")


@shipped_models_app.command(epilog="Example: python -m studies models truths --quick")
def truths(
    quick: Annotated[bool, typer.Option("--quick", help="Five models instead of all of the study.")] = False,
) -> None:
    """Identify random models whose truth is known, and count how often it lies in the stated intervals."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from studies.shipped_models.known_truths import coverage_table, recover_all  # noqa: PLC0415

    with ProgressBar("known truths (a few seconds each)") as bar:
        recoveries = recover_all(5 if quick else None, on_progress=bar.at)
    output_console().print(coverage_table(recoveries).rich())
