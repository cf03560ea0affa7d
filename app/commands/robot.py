"""`diffdrive-mpc identify`: from logs of a robot to a model that the controller loads, and how far to trust it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from diffdrive_mpc.app.commands.drives import Runs, Scheduler
from diffdrive_mpc.app.commands.options import Mapping, RobotName
from diffdrive_mpc.bench.command_line.completion import choices
from diffdrive_mpc.bench.command_line.echo import echo
from diffdrive_mpc.bench.command_line.one_line_errors import FAILED
from diffdrive_mpc.bench.command_line.options import Jobs, file_option, out_folder, out_option

IDENTIFY_EXAMPLE = "Example: diffdrive-mpc identify drive.csv --structure sm --out my_robot"
_DEFAULT_OUT = "identified"


def identify(
    *,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV or MCAP files, or ROS 2 bags.")],
    structure: Annotated[
        str,
        typer.Option(
            help="mbm, sm, ssm; p2_experimental or p2_physical, a drive; lstm, a network; hybrid, sm and network."
        ),
    ] = "sm",
    mapping: Mapping = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=out_folder,
            metavar="PATH",
            help="Folder for model, configuration and report.",
            show_default=_DEFAULT_OUT,
        ),
    ] = None,
    validate: Annotated[
        list[Path] | None,
        typer.Option(metavar="LOG", help="Log to try the model on; repeatable.", show_default="a share of each log"),
    ] = None,
    fit_share: Annotated[
        float | None,
        typer.Option(help="Share of each log to identify from; the rest scores it.", show_default="0.6"),
    ] = None,
    order: Annotated[str, typer.Option(metavar="auto|N", help="Order of an ssm, 1 to 5.")] = "auto",
    effects: Annotated[
        bool, typer.Option("--effects", help="Look for what the base does around an sm: slew, steps, tyres, veer.")
    ] = False,
    packages: Annotated[
        str | None,
        typer.Option(
            "--for",
            metavar="NAMES",
            help="Write parameters of nav2, ros2_control, robot_localization, too; several with commas.",
            show_default="none",
        ),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the model.", show_default="from the logs")] = None,
    robot: RobotName = None,
    draft_mapping: Annotated[
        bool, typer.Option("--draft-mapping", help="Only write a first mapping of LOG, to be corrected (mapping.yaml).")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write model and configuration also where logs or FIT speak against it.")
    ] = False,
) -> None:
    """Identify a velocity model from logs; write it with a configuration, a report and figures."""
    if draft_mapping:
        from diffdrive_mpc.app.identification.study import write_draft  # noqa: PLC0415

        write_draft(logs, out)
        return
    from diffdrive_mpc.app.identification.study import identify_into  # noqa: PLC0415 - --help does without it

    identify_into(
        logs,
        out or Path(_DEFAULT_OUT),
        structure=structure,
        mapping=mapping,
        validate=validate or [],
        fit_share=fit_share,
        order=order,
        effects=effects,
        name=name,
        robot=robot,
        packages=packages,
        force=force,
    )


# `diffdrive-mpc excite`: a drive that is worth learning from.


EXCITE_EXAMPLE = "Example: diffdrive-mpc excite ssm --for model --inside 4x3 --seconds 60 --out drive.yaml"
_SLIP, _MODEL = "slip", "model"
_SIDE, _SLIP_SECONDS, _SECONDS = 6.0, 90.0, 60.0


def excite(
    *,
    config: Annotated[
        str | None,
        typer.Argument(
            help="For the model: configuration of the controller that drives it, a file, or mbm, sm, ssm.",
            show_default="ssm",
            autocompletion=choices("config"),
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Trajectory file to write.", show_default=False)],
    purpose: Annotated[str, typer.Option("--for", help="What it is to tell: slip, or model.")] = _SLIP,
    side: Annotated[
        float | None,
        typer.Option(
            help="For slip: side of the square that it stays in; it begins in the middle [m].",
            show_default=f"{_SIDE:g}",
        ),
    ] = None,
    inside: Annotated[
        str | None,
        typer.Option(
            metavar="LxW",
            help="For the model: room that it stays in [m]; it begins in the middle, the length ahead.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            help="How long it lasts, about [s].", show_default=f"{_SLIP_SECONDS:g}; {_SECONDS:g} for the model"
        ),
    ] = None,
    speed: Annotated[float, typer.Option(help="Largest speed [m/s].")] = 0.6,
    yaw_rate: Annotated[float, typer.Option(help="Largest yaw rate [rad/s].")] = 1.0,
    log: Annotated[
        Path | None, typer.Option(help="For the model: drive it, and write this log (.csv, .mcap).", show_default=False)
    ] = None,
    plant: Annotated[
        str, typer.Option(help="With --log: the robot, as for simulate.", autocompletion=choices("plant"))
    ] = "mujoco",
    seed: Annotated[int, typer.Option(min=0, help="For the model: of the search, and of the noise.")] = 0,
) -> None:
    """Write a trajectory that is worth learning from, for `simulate --trajectory` and the node.

    For slip it tells the slip's terms apart. For the model it tells most of gains, lags and dead times: of held moves
    and of sums of sines the ones with the largest information (D-optimal), and how well these will be known.
    """
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415 - --help does without it

    if purpose not in (_SLIP, _MODEL):
        raise ConfigError(f"--for {purpose}: give {_SLIP} or {_MODEL}")
    others = {"--side": side} if purpose == _MODEL else {"CONFIG": config, "--inside": inside, "--log": log}
    given = [name for name, value in others.items() if value is not None]
    if given:
        raise ConfigError(f"{given[0]} does not go with --for {purpose}; leave it out")
    if purpose == _SLIP:
        _slip(out, side or _SIDE, seconds or _SLIP_SECONDS, speed, yaw_rate)
        return
    if inside is None:
        raise ConfigError(f"--for {_MODEL} needs --inside, the room in metres, such as --inside 4x3")
    _model(config or "ssm", out, read_room(inside), seconds or _SECONDS, speed, yaw_rate, log, plant, seed)


def _slip(out: Path, side: float, seconds: float, speed: float, yaw_rate: float) -> None:
    from diffdrive_mpc.mpc.trajectories.excitation import slip_excitation, told_apart, write_excitation  # noqa: PLC0415

    segments = slip_excitation(side, seconds, speed, yaw_rate)
    write_excitation(out, segments)
    correlation = told_apart(segments)
    echo(
        f"{out}: {len(segments)} twists, {sum(segment.duration for segment in segments):.0f} s without the time to "
        "change between them. Terms in v, omega and v omega: the two least apart correlate by "
        f"{correlation:.2f} (1: not apart)."
    )


def read_room(text: str) -> tuple[float, float]:
    """Length and width [m] of `4x3`; raises ValueError for anything else."""
    match = re.fullmatch(r"\s*([0-9.]+)\s*[x,]\s*([0-9.]+)\s*", text)
    try:
        if match:
            return float(match[1]), float(match[2])
    except ValueError:
        pass
    raise ValueError(f"--inside '{text}': give length and width in metres, such as 4x3")


def _model(
    config: str,
    out: Path,
    room: tuple[float, float],
    seconds: float,
    speed: float,
    yaw_rate: float,
    log: Path | None,
    plant: str,
    seed: int,
) -> None:
    from diffdrive_mpc_extras.excitation.command import excite_into  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc_extras.excitation.model_excitation import Room  # noqa: PLC0415

    excite_into(
        config, Room(*room), out, seconds=seconds, speed=speed, yaw_rate=yaw_rate, seed=seed, log=log, plant=plant
    )


# `diffdrive-mpc twin`: from a log of a robot to a plant that behaves like it.


TWIN_EXAMPLE = "Example: diffdrive-mpc twin drive.csv --robot my_robot.yaml --out my_twin"


def twin(
    *,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="CSV files or ROS 2 bags.")],
    out: Annotated[Path, out_option("plant.yaml, report.md, twin.json and figures/")],
    mapping: Mapping = None,
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="What is known of the robot (YAML): mass, wheel base, motors.",
            show_default="scaled from the track of the log",
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Identified linear model to begin with and to stand beside.",
            show_default="an SM, identified from the same rows",
        ),
    ] = None,
    effects: Annotated[
        bool, typer.Option("--effects", help="Look for what the base does around that SM: slew, steps, veer; minutes.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="How much of the log is fitted [s].", show_default="90")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the robot.", show_default="from the logs")] = None,
    jobs: Jobs = None,
    force: Annotated[bool, typer.Option("--force", help="Go on where the logs speak against it.")] = False,
) -> None:
    """Fit the physics plant to a log: what it tells, what not, and a plant file for `simulate --plant mujoco:FILE`."""
    from diffdrive_mpc_extras.twin.study import twin_into  # noqa: PLC0415 - --help does without it

    twin_into(
        logs,
        out,
        jobs=jobs,
        mapping=mapping,
        robot=robot,
        model=model,
        effects=effects,
        seconds=seconds,
        name=name,
        force=force,
    )


# `diffdrive-mpc tune`: search over the configuration of a controller, and comparison on other seeds.


TUNE_EXAMPLE = "Example: diffdrive-mpc tune ssm --out tuned"


def tune(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm.", autocompletion=choices("config")),
    ],
    *,
    out: Annotated[Path, out_option("config.yaml, tune.md and figures/")],
    plan: Annotated[Path | None, file_option("Plan", "--plan")] = None,
    plant: Annotated[
        str | None,
        typer.Option(help="mujoco:ROBOT, model:NAME, or the file of a robot or twin.", show_default="from the plan"),
    ] = None,
    points: Annotated[
        int | None, typer.Option(min=2, help="Configurations to try.", show_default="from the plan")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Search for weights, horizon, noises and limits with a small position error, and compare on other seeds.

    If no point is better on these seeds, config.yaml holds the start configuration, and the report says so.
    """
    from diffdrive_mpc.app.tune.study import tune as tuned  # noqa: PLC0415 - --help does without it

    result = tuned(config, out, plan=plan, plant=plant, points=points, jobs=jobs)
    echo(f"{result.sentence}; configuration in {result.config_path}")


# `diffdrive-mpc prove`: how often a controller fails, and where it stops to hold.


PROVE_EXAMPLE = "Example: diffdrive-mpc prove ssm --out proof --runs 40"


def prove(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: the path of a file, or mbm, sm, ssm.", autocompletion=choices("config")),
    ],
    *,
    out: Annotated[Path, out_option("prove.md, prove.parquet, figures/, worst/ and the rows of the runs")],
    campaign: Annotated[
        Path | None,
        typer.Option(
            "--campaign",
            help="Campaign with maps and boundaries (YAML), or market: robots drawn as wide as sold.",
            show_default=False,
        ),
    ] = None,
    runs: Runs = None,
    worst: Annotated[int, typer.Option(min=0, max=99, help="Worst runs to keep as files.")] = 10,
    tolerance: Annotated[
        str,
        typer.Option(
            metavar="M,M,...",
            help="Measure a speed passport in place of all this: the greatest speeds within these lateral errors [m].",
            show_default=False,
        ),
    ] = "",
    jobs: Jobs = None,
    scheduler: Scheduler = "",
) -> None:
    """Drive a controller on many plants, paths and faults: rates with intervals, maps, boundaries, worst runs.

    The exit code is 1 when a command was unsafe or a run ended in an error; the report is written all the same.
    """
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415
    from diffdrive_mpc_extras.campaign.engine import CampaignPlace, failed  # noqa: PLC0415 - --help does without it
    from diffdrive_mpc_extras.proof.proof_file import load_proof  # noqa: PLC0415
    from diffdrive_mpc_extras.proof.report import is_unsafe  # noqa: PLC0415
    from diffdrive_mpc_extras.proof.study import ProofStudy, keep  # noqa: PLC0415

    proof, place = load_proof(campaign), CampaignPlace(out, jobs, scheduler)
    if tolerance:
        from diffdrive_mpc_extras.proof.passport import PassportStudy, read_tolerances  # noqa: PLC0415

        measured = carry_out(PassportStudy(config, proof, place, read_tolerances(tolerance)), out, jobs)
        if complaint := failed(measured.driven):
            echo(f"error: {complaint}", err=True)
            raise typer.Exit(FAILED)
        return
    proven = carry_out(ProofStudy(config, proof, place, runs, worst), out, jobs)
    keep(proven, out)
    unsafe = sum(map(is_unsafe, proven.driven))
    complaint = f"{unsafe} runs had an unsafe command" if unsafe else failed(proven.driven)
    if complaint:
        echo(f"error: {complaint}", err=True)
        raise typer.Exit(FAILED)


# `diffdrive-mpc predict-error`: how far off it will be, before it drives.


PREDICT_ERROR_EXAMPLE = "Example: diffdrive-mpc predict-error --config ssm --trajectory s --out predicted"


def predict_error(
    *,
    config: Annotated[
        str,
        typer.Option(help="Configuration: the path of a file, or mbm, sm, ssm.", autocompletion=choices("config")),
    ] = "ssm",
    trajectory: Annotated[
        str, typer.Option(help="Name or path of the trajectory.", autocompletion=choices("trajectory"))
    ],
    population: Annotated[
        str, typer.Option(metavar="drawn|own", help="Any robot of the market, or the configuration's own.")
    ] = "drawn",
    calibration: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Calibration of your own robot's twin; else the shipped one.")
    ] = None,
    out: Annotated[Path, out_option("predicted-error.png and predicted-error.csv")],
) -> None:
    """Predict the tracking error of a trajectory before it is driven: tubes in which 95 % of drives stay, and why."""
    from diffdrive_mpc_extras.predicted_error.command import predict_into  # noqa: PLC0415 - --help does without it

    predict_into(config, trajectory, population, out, calibration)


# `diffdrive-mpc commission`: from an unknown robot to a proven controller.


COMMISSION_EXAMPLE = "Example: diffdrive-mpc commission heavy --inside 5x4 --out my_robot --quick"


def commission(
    *,
    robot: Annotated[
        str | None,
        typer.Argument(
            help="Robot of the physics that stands in for yours: a shipped name or a file.",
            show_default="none: a person drives",
        ),
    ] = None,
    out: Annotated[Path, out_option("a folder of each step, commission.json, and robot/ in the end")],
    inside: Annotated[str, typer.Option(metavar="LxW", help="Room in which it drives [m].")] = "5x4",
    config: Annotated[
        str, typer.Option(help="What drives it at first: a file, or mbm, sm, ssm.", autocompletion=choices("config"))
    ] = "ssm",
    known: Annotated[
        str | None,
        typer.Option(metavar="NAME|FILE", help="What is known of the robot (YAML), for the twin.", show_default=False),
    ] = None,
    stated: RobotName = None,
    log: Annotated[
        list[Path] | None, typer.Option(help="Log of the drive that was asked for; repeatable.", show_default=False)
    ] = None,
    mapping: Mapping = None,
    step: Annotated[bool, typer.Option("--step", help="Do only the next step that is not done.")] = False,
    tune: Annotated[bool, typer.Option("--tune/--no-tune", help="Tune the weights on the twin.")] = True,
    plan: Annotated[Path | None, file_option("Plan of the tuning", "--plan")] = None,
    runs: Annotated[int | None, typer.Option(min=1, help="Of the proof.", show_default="300")] = None,
    scale_to_robot: Annotated[
        bool, typer.Option("--scale-to-robot", help="Fit the proof's paths to the robot.")
    ] = False,
    drawn: Annotated[
        int | None,
        typer.Option(min=0, help="Commission a robot that is drawn from this seed, and compare.", show_default=False),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Short drives, few runs, no tuning: to see that it works.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of searches, and of the noise of the drives.")] = 0,
    jobs: Jobs = None,
) -> None:
    """Excite, record, identify, fit a twin, tune and prove: each step once, each gated by the one before.

    The robot is a simulated one, or a person drives: then the command says what to drive, and takes the log. The exit
    code is 1 where a step does not pass.
    """
    from diffdrive_mpc.app.commission.commissioning import CommissionRequest, NeedsAPersonError  # noqa: PLC0415 - --help
    from diffdrive_mpc.app.commission.ledger import commission_settings  # noqa: PLC0415
    from diffdrive_mpc.app.commission.run import commission_into  # noqa: PLC0415
    from diffdrive_mpc_extras.excitation.model_excitation import Room  # noqa: PLC0415

    if drawn is not None and robot is not None:
        raise ValueError(f"--drawn {drawn}: it draws the robot; leave '{robot}' out")
    simulated = robot is not None or drawn is not None
    if log and simulated:
        raise ValueError("--log: the simulated robot is driven here; leave it out, or the robot")
    request = CommissionRequest(
        Room(*read_room(inside)),
        robot,
        config,
        known,
        tuple(log or ()),
        mapping,
        tuned=tune,
        plan=None if plan is None else str(plan),
        stated=stated,
        scaled=scale_to_robot,
        seed=seed,
        jobs=jobs,
        runs=commission_settings().proof.runs if runs is None else runs,
    )
    if quick and (runs is not None or plan is not None):
        raise ValueError("--quick has runs of its own and does not tune; leave --runs and --plan out")
    try:
        passed = commission_into(request.quick() if quick else request, out, one_step=step, drawn=drawn)
    except NeedsAPersonError as need:
        echo(f"Next: {need}.")
        return
    if not passed:
        raise typer.Exit(FAILED)
