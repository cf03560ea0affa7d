"""Commands of the studies."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from diffdrive_mpc.app.command_line.options import Jobs, file_option, out_option
from diffdrive_mpc.bench.case import parse_seeds, split_names, split_numbers

if TYPE_CHECKING:
    from diffdrive_mpc.bench.study import Study


Results = TypeVar("Results")

EXAMPLES = {
    "tracking": "Example: python -m studies tracking --out results --quick --only cross,bound",
    "reproduce": "Example: python -m studies reproduce --out results --only virtual_track",
    "peers": "Example: python -m studies peers --out results --peers pursuit,lqr+slip",
    "robustness": "Example: python -m studies robustness --out results --only mass_left,frozen_pose --models sm,ssm",
    "speed": "Example: python -m studies speed --out results --quick --peers ours,acados",
}


def _parts_option(parts: str) -> Any:  # noqa: ANN401 - typer has no type for options
    """Create the option that selects parts of a study."""
    return typer.Option("--only", metavar="PARTS", help=f"{parts}.", show_default="all parts")


def _names_option(content: str, default: str | bool = True, name: str | None = None) -> Any:  # noqa: ANN401 - typer has no type for options
    """Create an option whose value is a list of names, separated by commas."""
    return typer.Option(*([name] if name else []), metavar="NAMES", help=f"{content}.", show_default=default)


def _carry_out(study: Study[Any, Results], out: Path, jobs: int | None = None) -> Results:
    """Run a study, write its report to `out`, and return its results."""
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    return carry_out(study, out, jobs)


def tracking(
    *,
    out: Annotated[Path, out_option("report.html, tracking.json, tracking.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of less than a minute.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    only: Annotated[str | None, _parts_option("targets, ablation, cross, surfaces, scenarios, floor, bound")] = None,
    jobs: Jobs = None,
) -> None:
    """Run the tracking study and write its tables and figures; takes about ten minutes on two cores."""
    from studies.tracking.study import TrackingStudy, load_study  # noqa: PLC0415 - --help does not need it

    if quick and study is not None:
        raise ValueError(f"--study {study}: --quick selects another study file; pass only one of the two options")
    parts = () if only is None else split_names(only, "--only")
    _carry_out(TrackingStudy(load_study(study, quick=quick), parts), out, jobs)


def reproduce(
    *,
    out: Annotated[Path, out_option("report.html, reproduce.json, reproduce.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of less than a minute.")] = False,
    only: Annotated[str | None, _parts_option("mbm_sm, ssm, lstm, cost, virtual_track, drive_models")] = None,
    data: Annotated[
        Path | None,
        typer.Option(envvar="DIFFDRIVE_MPC_DATA", help="Folder with the real logs.", show_default="no real logs"),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Repeat the papers' experiments on the simulated robot and check the papers' findings; takes minutes."""
    from studies.reproduce.published import PARTS, load_study  # noqa: PLC0415 - --help does not need it
    from studies.reproduce.study import ReproduceStudy  # noqa: PLC0415

    parts = PARTS if only is None else split_names(only, "--only")
    _carry_out(ReproduceStudy(load_study(quick=quick), parts, data), out, jobs)


def peers(
    *,
    out: Annotated[Path, out_option("report.html, peers.json, peers.md and gains.yaml")],
    quick: Annotated[bool, typer.Option("--quick", help="One peer and a few settings, as a test.")] = False,
    only: Annotated[str | None, _names_option("Peers to tune", "all of them", "--peers")] = None,
    settings: Annotated[Path | None, file_option("Settings", "--settings")] = None,
    jobs: Jobs = None,
) -> None:
    """Tune all peers by the same search on the same runs with the same budget; takes about 20 minutes on two cores."""
    from diffdrive_mpc.models.whole_file import whole_file  # noqa: PLC0415
    from studies.peers.study import GAINS_FILE, PeersStudy, gains_text, load_settings  # noqa: PLC0415 - --help does not need it

    study_settings = load_settings(settings, quick=quick)
    results = _carry_out(PeersStudy(study_settings, None if only is None else split_names(only, "--peers")), out, jobs)
    with whole_file(out / GAINS_FILE) as draft:
        draft.write_text(gains_text(results, study_settings), encoding="utf-8")


def _parse_rates(text: str) -> list[float]:
    """Parse rates of false alarms [1/h], separated by commas; raise ConfigError if an entry is not a number."""
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415

    try:
        return [float(entry) for entry in split_names(text, "--rates")]
    except ValueError:
        raise ConfigError(f"--rates {text}: expected numbers above 0, such as 1,10,100") from None


def robustness(
    *,
    out: Annotated[Path, out_option("report.html, robustness.json, robustness.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A few conditions on one path.")] = False,
    only: Annotated[str | None, _names_option("Conditions", "all of them")] = None,
    conditions: Annotated[Path | None, file_option("Conditions", "--conditions")] = None,
    controllers: Annotated[str, _names_option("Controllers: mpc, and names of peers")] = "mpc,kanayama",
    models: Annotated[str, _names_option("Models of mpc")] = "ssm",
    trajectories: Annotated[str | None, _names_option("Paths", "circle,s; circle with --quick")] = None,
    seeds: Annotated[str, typer.Option(metavar="LIST", help="Number of seeds, or a list of seeds.")] = "1",
    robots: Annotated[
        int | None,
        typer.Option(min=1, help="Number of random robots of the market; replaces conditions not set by --only."),
    ] = None,
    tuning_robots: Annotated[
        bool,
        typer.Option("--tuning-robots", help="Use the random robots for tuning instead of the reserved robots."),
    ] = False,
    rates: Annotated[
        str | None,
        typer.Option(
            metavar="LIST", help="Additional rates of false alarms [1/h] for the random robots.", show_default="none"
        ),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Run every controller on robots, surfaces and sensors for which it was not tuned; takes minutes on two cores."""
    from diffdrive_mpc_extras.campaign.campaign_file import load_conditions  # noqa: PLC0415 - --help does not need it
    from studies.robustness.study import RobustnessStudy  # noqa: PLC0415

    campaign = load_conditions(conditions)
    names = split_names(only, "--only") if only is not None else campaign.quick if quick else None
    study = RobustnessStudy(
        campaign.select(names) if names is not None or robots is None else {},
        campaign.settled,
        controllers=split_names(controllers, "--controllers"),
        models=split_names(models, "--models"),
        trajectories=split_names(trajectories or ("circle" if quick else "circle,s"), "--trajectories"),
        seeds=parse_seeds(seeds),
        robots=robots or 0,
        tuning=tuning_robots,
        rates=[] if rates is None else _parse_rates(rates),
    )
    _carry_out(study, out, jobs)


def speed(
    *,
    out: Annotated[Path, out_option("report.html, speed.json, speed.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="One model, two horizons, a short drive.")] = False,
    peers: Annotated[str | None, _names_option("Subjects; `ours` and `casadi` are groups", "all of them")] = None,
    models: Annotated[str | None, _names_option("Models", "mbm,sm,ssm")] = None,
    horizons: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Horizons.", show_default="10,20,30,50,100")
    ] = None,
    settings: Annotated[Path | None, file_option("Settings", "--settings")] = None,
    environment: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the peers' virtual environment, which is created if missing.",
            show_default="in the user's cache folder",
        ),
    ] = None,
) -> None:
    """Time the steps of the controller and of its peers on the same problem; takes about a quarter of an hour."""
    from studies.speed.settings import MAX_STEPS, load_speed_settings, select_subjects  # noqa: PLC0415 - --help does not need it
    from studies.speed.study import SpeedStudy  # noqa: PLC0415

    study_settings = load_speed_settings(settings, quick=quick)
    changes: dict[str, object] = {}
    if models is not None:
        changes["models"] = split_names(models, "--models")
    if horizons is not None:
        changes["horizons"] = split_numbers(horizons, "--horizons", minimum=1, maximum=MAX_STEPS)
    names = None if peers is None else split_names(peers, "--peers")
    _carry_out(SpeedStudy(select_subjects(study_settings.model_copy(update=changes), names), environment), out)


STUDIES: dict[str, Callable[..., None]] = {
    "tracking": tracking,
    "robustness": robustness,
    "peers": peers,
    "reproduce": reproduce,
    "speed": speed,
}
"""Functions of the commands by NAME in `python -m studies NAME`."""


shipped_models_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Repeat the identification of the built-in models and the calibration of the simulated robot's firmware.",
)


@shipped_models_app.command(epilog="Example: python -m studies models fit --out my_models")
def fit(
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for mbm.yaml and sm.yaml; by default the built-in folder.", show_default=False),
    ] = None,
) -> None:
    """Identify MBM and SM from the papers' experiments, which are run on the simulated robot."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.models.load import PARAMETERS  # noqa: PLC0415
    from studies.shipped_models.model_fitting import fit_models  # noqa: PLC0415

    with ProgressBar("experiments and identification (about a minute)") as bar:
        table, warnings = fit_models(out or PARAMETERS, on_progress=bar.show)
    output_console().print(table.rich())
    for warning in warnings:
        typer.echo(f"warning: {warning}", err=True)


@shipped_models_app.command(epilog="Example: python -m studies models drives --out my_models")
def drives(
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for p2_experimental.yaml and p2_physical.yaml; by default the built-in folder.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Fit the drive models to drives of the simulated robot with changes of direction."""
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
        typer.Option(help="Folder for lstm.yaml and lstm.npz; by default the built-in folder.", show_default=False),
    ] = None,
) -> None:
    """Train the network on a five-minute drive of the simulated robot; requires the extra `learn`."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.models.load import PARAMETERS  # noqa: PLC0415
    from studies.shipped_models.model_fitting import fit_network  # noqa: PLC0415

    folder = out or PARAMETERS
    folder.mkdir(parents=True, exist_ok=True)
    with ProgressBar("drives and training (about a minute)") as bar:
        table = fit_network(folder, on_progress=bar.show)
    output_console().print(table.rich())


@shipped_models_app.command(epilog="Example: python -m studies models calibrate --out my_firmware.yaml")
def calibrate(
    out: Annotated[
        Path | None, typer.Option(help="Parameter file to write; by default the built-in file.", show_default=False)
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Only report how well the built-in calibration predicts validation drives, and check that no "
            "neighbouring value fits better.",
        ),
    ] = False,
) -> None:
    """Fit the simulated robot's firmware such that the published SSM predicts the robot's measurements."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from diffdrive_mpc.sim.plants.twin_parameters import FIRMWARE_FILE, load_firmware  # noqa: PLC0415
    from studies.shipped_models.calibration import calibrate as fit_firmware  # noqa: PLC0415
    from studies.shipped_models.calibration import (  # noqa: PLC0415
        calibration_table,
        neighbour_errors,
        neighbours_table,
    )

    if check and out is not None:
        raise ValueError(f"--out {out}: --check writes nothing; pass only one of the two options")
    neighbours: dict[str, tuple[float, ...]] = {}
    if check:
        firmware, neighbours = load_firmware(), neighbour_errors()
        output_console().print(neighbours_table(neighbours).rich())
    else:
        with ProgressBar("calibration (a few minutes), evaluations:") as bar:
            firmware = fit_firmware(out or FIRMWARE_FILE, on_evaluation=bar.advance)
    output_console().print(calibration_table(firmware).rich())
    improvable = [name for name, errors in neighbours.items() if min(errors) <= 1.0]
    if improvable:
        raise ValueError(f"firmware.yaml: another value of {', '.join(improvable)} fits better: run make calibrate")


@shipped_models_app.command(epilog="Example: python -m studies models truths --quick")
def truths(
    quick: Annotated[bool, typer.Option("--quick", help="Use five models instead of all.")] = False,
) -> None:
    """Identify random models and compute the share of the confidence intervals that contain the true parameters."""
    from diffdrive_mpc.bench.progress import ProgressBar, output_console  # noqa: PLC0415
    from studies.shipped_models.known_truths import coverage_table, recover_all  # noqa: PLC0415

    with ProgressBar("random models (a few seconds each)") as bar:
        recoveries = recover_all(5 if quick else None, on_progress=bar.show)
    output_console().print(coverage_table(recoveries).rich())
