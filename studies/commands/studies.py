"""The commands of the studies that compare controllers, robots and paths."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from diffdrive_mpc.bench.case import parse_seeds, split_names, split_numbers
from diffdrive_mpc.bench.command_line.options import Jobs, file_option, out_folder, out_option

if TYPE_CHECKING:
    from diffdrive_mpc.bench.study import Study

Results = TypeVar("Results")

_QUICK = 2
"""Runs of each part of `worlds --quick`."""
EXAMPLES = {
    "tracking": "Example: python -m studies tracking --out results --quick --only cross,bound",
    "reproduce": "Example: python -m studies reproduce --out results --only virtual_track",
    "peers": "Example: python -m studies peers --out results --peers pursuit,lqr+slip",
    "energy-front": "Example: python -m studies energy-front --out results --quick",
    "torque": "Example: python -m studies torque --out results --quick",
    "saving": "Example: python -m studies saving --out results --quick",
    "robustness": "Example: python -m studies robustness --out results --only mass_left,frozen_pose --models sm,ssm",
    "worlds": "Example: python -m studies worlds --out results --quick --controllers mpc,rpp+stop",
    "speed": "Example: python -m studies speed --out results --quick --peers ours,acados",
    "predicted-error": "Example: python -m studies predicted-error --out predicted --quick",
    "monitor": "Example: python -m studies monitor --out watched --seeds 2 --hours 0.2",
    "real-logs": "Example: python -m studies real-logs husky --data logs --out husky",
    "stack": "Example: python -m studies stack --out results --robots 20",
    "loop-speed": "Example: python -m studies loop-speed --out results --models ssm --trajectories circle,s",
}


def _parts_option(parts: str) -> Any:  # noqa: ANN401 - typer's own type
    """The option that chooses some parts of a study."""
    return typer.Option("--only", metavar="PARTS", help=f"{parts}.", show_default="all of them")


def _names(what: str, default: str | bool = True, name: str | None = None) -> Any:  # noqa: ANN401 - typer's own type
    """The option that takes names, with commas between."""
    return typer.Option(*([name] if name else []), metavar="NAMES", help=f"{what}.", show_default=default)


Floors = Annotated[str | None, _names("Floors, with commas between", "those of the study", "--surfaces")]


def _carry_out(study: Study[Any, Results], out: Path, jobs: int | None = None) -> Results:
    """As `bench.study.carry_out`, which is imported when a study runs: --help does without it."""
    from diffdrive_mpc.bench.study import carry_out  # noqa: PLC0415

    return carry_out(study, out, jobs)


def tracking(
    *,
    out: Annotated[Path, out_option("report.html, tracking.json, tracking.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of under a minute.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    only: Annotated[str | None, _parts_option("targets, ablation, cross, surfaces, scenarios, bound")] = None,
    jobs: Jobs = None,
) -> None:
    """Run the tracking study and write its tables and figures: about ten minutes on two cores."""
    from studies.tracking.study import TrackingStudy, load_study  # noqa: PLC0415 - --help does without it

    if quick and study is not None:
        raise ValueError(f"--study {study}: --quick has a study of its own; give one of them")
    parts = () if only is None else split_names(only, "--only")
    _carry_out(TrackingStudy(load_study(study, quick=quick), parts), out, jobs)


def reproduce(
    *,
    out: Annotated[Path, out_option("report.html, reproduce.json, reproduce.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A small study of under a minute.")] = False,
    only: Annotated[str | None, _parts_option("mbm_sm, ssm, lstm, cost, virtual_track, drive_models")] = None,
    data: Annotated[
        Path | None,
        typer.Option(envvar="DIFFDRIVE_MPC_DATA", help="Folder with the real logs.", show_default="without them"),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Repeat the papers' experiments on the simulated robot and say which findings hold: minutes on two cores."""
    from studies.reproduce.published import PARTS, load_study  # noqa: PLC0415 - --help does without it
    from studies.reproduce.study import ReproduceStudy  # noqa: PLC0415

    parts = PARTS if only is None else split_names(only, "--only")
    _carry_out(ReproduceStudy(load_study(quick=quick), parts, data), out, jobs)


def peers(
    *,
    out: Annotated[Path, out_option("report.html, peers.json, peers.md and gains.yaml")],
    quick: Annotated[bool, typer.Option("--quick", help="One peer and a few settings, to see that it works.")] = False,
    only: Annotated[str | None, _names("Peers to tune", "all of them", "--peers")] = None,
    settings: Annotated[Path | None, file_option("Settings", "--settings")] = None,
    jobs: Jobs = None,
) -> None:
    """Tune the peers, each by the same search with the same budget on the same runs: about 20 minutes on two cores."""
    from diffdrive_mpc.models.whole_file import whole_file  # noqa: PLC0415
    from studies.peers.study import GAINS_FILE, PeersStudy, gains_text, load_settings  # noqa: PLC0415 - --help does without it

    loaded = load_settings(settings, quick=quick)
    results = _carry_out(PeersStudy(loaded, None if only is None else split_names(only, "--peers")), out, jobs)
    with whole_file(out / GAINS_FILE) as draft:
        draft.write_text(gains_text(results, loaded), encoding="utf-8")


def _rates(text: str) -> list[float]:
    from diffdrive_mpc.models.checked_yaml import ConfigError  # noqa: PLC0415

    try:
        return [float(name) for name in split_names(text, "--rates")]
    except ValueError:
        raise ConfigError(f"--rates {text}: expected numbers above 0, such as 1,10,100") from None


def robustness(
    *,
    out: Annotated[Path, out_option("report.html, robustness.json, robustness.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="A few conditions on one path.")] = False,
    only: Annotated[str | None, _names("Conditions", "all of them")] = None,
    conditions: Annotated[Path | None, file_option("Conditions", "--conditions")] = None,
    controllers: Annotated[str, _names("mpc, or peers")] = "mpc,kanayama",
    models: Annotated[str, _names("Models of mpc")] = "ssm",
    trajectories: Annotated[str | None, _names("Paths", "circle,s; circle with --quick")] = None,
    seeds: Annotated[str, typer.Option(metavar="LIST", help="How many seeds, or a list of them.")] = "1",
    robots: Annotated[
        int | None,
        typer.Option(min=1, help="Drive so many drawn robots, as wide as the market, and no condition."),
    ] = None,
    tuning_robots: Annotated[
        bool,
        typer.Option("--tuning-robots", help="Drawn robots to tune on in place of the reserved ones."),
    ] = False,
    rates: Annotated[
        str | None,
        typer.Option(
            metavar="LIST", help="Rates of false alarms [1/h] to drive these robots at, too.", show_default="none"
        ),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Drive every controller on robots, floors and sensors that it was not tuned to: some minutes on two cores."""
    from diffdrive_mpc.bench.campaign.conditions import load_conditions  # noqa: PLC0415 - --help does without it
    from studies.robustness.study import RobustnessStudy  # noqa: PLC0415

    loaded = load_conditions(conditions)
    names = split_names(only, "--only") if only is not None else loaded.quick if quick else None
    study = RobustnessStudy(
        loaded.chosen(names) if names is not None or robots is None else {},
        loaded.settled,
        controllers=split_names(controllers, "--controllers"),
        models=split_names(models, "--models"),
        trajectories=split_names(trajectories or ("circle" if quick else "circle,s"), "--trajectories"),
        seeds=parse_seeds(seeds),
        robots=robots or 0,
        tuning=tuning_robots,
        rates=[] if rates is None else _rates(rates),
    )
    _carry_out(study, out, jobs)


def worlds(
    *,
    out: Annotated[Path, out_option("report.html, worlds.json, worlds.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="Two runs of each part.")] = False,
    only: Annotated[str | None, _parts_option("drawn, doorway, crossing, named")] = None,
    controllers: Annotated[str, _names("mpc, or peers")] = "mpc,mppi+grid,rpp+stop",
    model: Annotated[str, typer.Option(metavar="NAME", help="Model of mpc.")] = "ssm",
    runs: Annotated[int | None, typer.Option(min=1, help="Drawn worlds.", show_default="1000")] = None,
    crossings: Annotated[int | None, typer.Option(min=1, help="Persons who cross.", show_default="1000")] = None,
    seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    jobs: Jobs = None,
) -> None:
    """Drive through drawn and named worlds, count contacts, and compare with peers that see the same: hours in full."""
    from diffdrive_mpc.bench.study import check_parts  # noqa: PLC0415
    from studies.worlds.settings import PARTS, load_settings  # noqa: PLC0415 - --help does without it
    from studies.worlds.study import WorldsStudy  # noqa: PLC0415

    parts = PARTS if only is None else split_names(only, "--only")
    check_parts(parts, PARTS)
    names = split_names(controllers, "--controllers")
    counts = dict.fromkeys(PARTS, _QUICK) if quick else {}
    counts |= {part: asked for part, asked in (("drawn", runs), ("crossing", crossings)) if asked is not None}
    _carry_out(WorldsStudy(load_settings(), parts, controllers=names, model=model, runs=counts, first=seed), out, jobs)


def speed(
    *,
    out: Annotated[Path, out_option("report.html, speed.json, speed.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="One model, two horizons, a short drive.")] = False,
    peers: Annotated[str | None, _names("Subjects; `ours` and `casadi` are groups", "all of them")] = None,
    models: Annotated[str | None, _names("Models", "mbm,sm,ssm")] = None,
    horizons: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Horizons.", show_default="10,20,30,50,100")
    ] = None,
    settings: Annotated[Path | None, file_option("Settings", "--settings")] = None,
    environment: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the peers' own environment; made there if it is not.",
            show_default="in the user's cache folder",
        ),
    ] = None,
) -> None:
    """Time whole steps of the controller and of its peers on the same problem: about a quarter of an hour."""
    from studies.speed.settings import MOST_STEPS, chosen, load_speed_settings  # noqa: PLC0415 - --help does without it
    from studies.speed.study import SpeedStudy  # noqa: PLC0415

    loaded = load_speed_settings(settings, quick=quick)
    changes: dict[str, object] = {}
    if models is not None:
        changes["models"] = split_names(models, "--models")
    if horizons is not None:
        changes["horizons"] = split_numbers(horizons, "--horizons", least=1, most=MOST_STEPS)
    names = None if peers is None else split_names(peers, "--peers")
    _carry_out(SpeedStudy(chosen(loaded.model_copy(update=changes), names), environment), out)


def loop_speed(
    *,
    out: Annotated[Path, out_option("report.html, loop-speed.json and loop-speed.md")],
    models: Annotated[str, _names("Models of the controller")] = "ssm",
    trajectories: Annotated[str, _names("Paths")] = "circle,square,s,cane",
    plant: Annotated[str, typer.Option(metavar="NAME", help="Plant.")] = "mujoco",
    scenario: Annotated[str, typer.Option(metavar="NAME", help="What happens on the way.")] = "none",
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How often each is driven; the least time counts.")] = 5,
) -> None:
    """Say how many times as fast as real time the closed loop is simulated on one core, whole and by part."""
    from studies.loop_speed.study import LoopSpeedStudy  # noqa: PLC0415 - --help does without it

    paths = split_names(trajectories, "--trajectories")
    _carry_out(LoopSpeedStudy(split_names(models, "--models"), paths, plant, scenario, repeats), out)


def energy_front(
    *,
    out: Annotated[Path, out_option("report.html, energy-front.json, energy-front.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="One path and three weights, to see that it works.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    jobs: Jobs = None,
) -> None:
    """Energy against tracking error as the weight of energy in the controller grows; minutes on two cores."""
    from studies.energy_front.study import (  # noqa: PLC0415 - --help does without it
        HERE,
        EnergyFrontStudy,
        load_study,
        small,
    )

    asked = load_study(study)
    _carry_out(EnergyFrontStudy(small(asked) if quick else asked, study.parent if study else HERE), out, jobs)


def torque(
    *,
    out: Annotated[Path, out_option("report.html, torque.json, torque.md, turn-costs-FLOOR.yaml and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="One floor and few turns, to see that it works.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    surfaces: Floors = None,
    jobs: Jobs = None,
) -> None:
    """What a turn costs: torque, least radius and energy, measured, learned and predicted; minutes on two cores."""
    from studies.torque.settings import load_study, small  # noqa: PLC0415 - --help does without it
    from studies.torque.study import TorqueStudy  # noqa: PLC0415

    asked = load_study(study)
    asked = small(asked) if quick else asked
    if surfaces is not None:
        asked = asked.model_copy(update={"surfaces": split_names(surfaces, "--surfaces")})
    _carry_out(TorqueStudy(asked), out, jobs)


def saving(
    *,
    out: Annotated[Path, out_option("report.html, saving.json, saving.md and figures/")],
    quick: Annotated[bool, typer.Option("--quick", help="One floor and two pairs, to see that it works.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    surfaces: Floors = None,
    jobs: Jobs = None,
) -> None:
    """Drive energy-optimal and distance-optimal paths of the same ends, and say what is saved: minutes on two cores."""
    from studies.saving.settings import load_study, small  # noqa: PLC0415 - --help does without it
    from studies.saving.study import SavingStudy  # noqa: PLC0415

    asked = load_study(study)
    asked = small(asked) if quick else asked
    if surfaces is not None:
        asked = asked.model_copy(update={"surfaces": split_names(surfaces, "--surfaces")})
    _carry_out(SavingStudy(asked), out, jobs)


def monitor(
    *,
    out: Annotated[Path, out_option("monitor.md, monitor.json and figures/", "out/monitor")] = Path("out/monitor"),
    rules: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="Rules: a shipped name, or the path of a YAML file.")
    ] = "default",
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Drives of each fault.")] = 20,
    hours: Annotated[float, typer.Option(min=0.01, max=1000, help="Hours of nominal drives.")] = 10.0,
    tuning: Annotated[bool, typer.Option("--tuning", help="The seeds that the rules were tuned on.")] = False,
    market: Annotated[bool, typer.Option("--market", help="Nominal drives of drawn robots of the market.")] = False,
    jobs: Jobs = None,
) -> None:
    """Break controllers on purpose and drive for hours with sound ones: what the monitor catches, when, and what not.

    The exit code is 1 when a fault was missed or found late, or a nominal drive alarmed in which the robot stays near
    its path and on time; the report is written all the same.
    """
    from diffdrive_mpc.bench.command_line.one_line_errors import FAILED  # noqa: PLC0415 - --help does without it
    from studies.monitor.study import MonitorStudy, complaint  # noqa: PLC0415

    problem = complaint(_carry_out(MonitorStudy(rules, seeds, hours, tuning=tuning, market=market), out, jobs))
    if problem:
        typer.echo(f"error: {problem}", err=True)
        raise typer.Exit(FAILED)


def stack(
    *,
    out: Annotated[Path, out_option("report.html, stack.json and stack.md")],
    only: Annotated[str | None, _parts_option("robots, peers")] = None,
    robots: Annotated[int, typer.Option(min=1, help="How many drawn robots.")] = 200,
    tuning_robots: Annotated[bool, typer.Option("--tuning-robots", help="Robots to tune on.")] = False,
    drives: Annotated[Path | None, file_option("Drives of the peers", "--drives")] = None,
    jobs: Jobs = None,
) -> None:
    """Hold parameters for other packages against drawn robots, and drive peers with them: half an hour on two cores."""
    from diffdrive_mpc.bench.study import check_parts  # noqa: PLC0415 - --help does without it
    from studies.stack.peers import load_peer_drives  # noqa: PLC0415
    from studies.stack.study import StackStudy  # noqa: PLC0415

    parts = ("robots", "peers") if only is None else split_names(only, "--only")
    check_parts(parts, ("robots", "peers"))
    peers = load_peer_drives(drives) if "peers" in parts else None
    _carry_out(StackStudy(robots if "robots" in parts else 0, tuning=tuning_robots, peers=peers), out, jobs)


def real_logs(
    log: Annotated[str, typer.Argument(help="husky, warthog-asphalt or warthog-gravel.")],
    *,
    data: Annotated[Path, typer.Option(envvar="DIFFDRIVE_MPC_DATA", help="Folder with the logs.", show_default=False)],
    out: Annotated[
        Path,
        typer.Option(
            parser=out_folder, metavar="PATH", help="Folder for proof.md, model.yaml, config.yaml and surface.yaml."
        ),
    ],
    seeds: Annotated[int, typer.Option(min=0, help="Closed-loop runs of each kind; 0 for none.")] = 3,
) -> None:
    """Identify a real robot with the effects of its base, score it on held-out rows, and drive its stand-in."""
    from studies.real_logs.study import prove_log  # noqa: PLC0415 - --help and other commands do without it

    prove_log(log, data, out, seeds)


def predicted_error(
    *,
    out: Annotated[Path, out_option("report.html, predicted-error.json, predicted-error.md and calibration.yaml")],
    quick: Annotated[bool, typer.Option("--quick", help="Few drives of one population, to see that it works.")] = False,
    study: Annotated[Path | None, file_option("Study file", "--study")] = None,
    kept: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Keep driven sets there, and go on from them.", show_default=False),
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Calibrate the predicted tracking error, and say how far it holds on other drives: a quarter of an hour."""
    from studies.predicted_error.drives import load_study  # noqa: PLC0415 - --help does without it
    from studies.predicted_error.study import PredictedErrorStudy  # noqa: PLC0415

    if quick and (study is not None or kept is not None):
        raise ValueError("--quick has a study of its own and keeps nothing; give it alone")
    _carry_out(PredictedErrorStudy(load_study(study, quick=quick), kept), out, jobs)


STUDIES: dict[str, Callable[..., None]] = {
    "tracking": tracking,
    "robustness": robustness,
    "worlds": worlds,
    "peers": peers,
    "reproduce": reproduce,
    "torque": torque,
    "saving": saving,
    "energy-front": energy_front,
    "speed": speed,
    "loop-speed": loop_speed,
    "real-logs": real_logs,
    "stack": stack,
    "monitor": monitor,
    "predicted-error": predicted_error,
}
"""The studies by the names of their commands, `python -m studies NAME`."""
