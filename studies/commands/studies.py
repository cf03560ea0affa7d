"""The commands of the studies that compare controllers, robots and paths."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from diffdrive_mpc.app.command_line.options import Jobs, file_option, out_folder, out_option
from diffdrive_mpc.bench.case import parse_seeds, split_names, split_numbers

if TYPE_CHECKING:
    from diffdrive_mpc.bench.study import Study

Results = TypeVar("Results")

EXAMPLES = {
    "tracking": "Example: python -m studies tracking --out results --quick --only cross,bound",
    "reproduce": "Example: python -m studies reproduce --out results --only virtual_track",
    "peers": "Example: python -m studies peers --out results --peers pursuit,lqr+slip",
    "energy-front": "Example: python -m studies energy-front --out results --quick",
    "torque": "Example: python -m studies torque --out results --quick",
    "saving": "Example: python -m studies saving --out results --quick",
    "robustness": "Example: python -m studies robustness --out results --only mass_left,frozen_pose --models sm,ssm",
    "speed": "Example: python -m studies speed --out results --quick --peers ours,acados",
    "real-logs": "Example: python -m studies real-logs husky --data logs --out husky",
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
    from diffdrive_mpc_extras.campaign.conditions import load_conditions  # noqa: PLC0415 - --help does without it
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


STUDIES: dict[str, Callable[..., None]] = {
    "tracking": tracking,
    "robustness": robustness,
    "peers": peers,
    "reproduce": reproduce,
    "torque": torque,
    "saving": saving,
    "energy-front": energy_front,
    "speed": speed,
    "loop-speed": loop_speed,
    "real-logs": real_logs,
}
"""The studies by the names of their commands, `python -m studies NAME`."""
