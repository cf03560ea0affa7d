"""Measure the tubes of `predict-error` on robots with independent physics: excite, identify, predict, drive.

    python packages/extras/tests/tubes_of_foreign_robots.py FOLDER tyres:10 belts:11 castors:12

Each robot is identified as SM and as SSM. Each model drives two of five paths five times. FOLDER contains logs, models
and errors; `rows.csv` gets a row after each path. `--oracle N` adds N drives of each path, from which the tube of an
oracle is computed. A robot with a model in FOLDER is not identified again.
"""

import sys
from functools import cache, partial
from pathlib import Path

import numpy as np
from foreign_plants import FOREIGN

from diffdrive_mpc.app.identification.unexplained_motion import identified_robot, write_robot
from diffdrive_mpc.app.run_log import run_log
from diffdrive_mpc.bench.controllers import load_reference
from diffdrive_mpc.models.identification import identify
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.sim import simulate
from diffdrive_mpc_extras.campaign.own_plant import own_plant
from diffdrive_mpc_extras.excitation.excite import check_drive, excite_model
from diffdrive_mpc_extras.excitation.model_excitation import Room
from diffdrive_mpc_extras.predicted_error.drives import absolute_errors, drive_case, predict_by_drives, tube

_DRIVES, _SEED = 5, 9000
_PATHS = ("s", "circle", "spline", "square", "cane")


@cache
def planned_excitation():
    """Plan an excitation of 120 s in a room of 6 m by 6 m."""
    return excite_model("ssm", Room(6.0, 6.0), seconds=120.0, seed=7)


def record_excitation(folder, make_plant):
    """Drive the excitation; return the path of the log."""
    excitation = planned_excitation()
    path, log = folder / "excitation.yaml", folder / "log.csv"
    excitation.write(path)
    config = load_config("ssm")
    run = simulate(Controller(config), make_plant(7), load_trajectory(path, config))
    check_drive(run, excitation.room)
    with run_log(log) as write:
        write(run, excitation.case)
    return log


def identify_robot(folder, make_plant, structure="sm"):
    """Identify model, configuration and robot from the log in `folder`; return the path of the configuration.

    If the log is missing, it is recorded first.
    """
    log, model_folder = folder / "log.csv", folder / structure
    if not (model_folder / "robot.yaml").exists():
        identification = identify([log if log.exists() else record_excitation(folder, make_plant)], structure=structure)
        if identification.refusal:
            raise ValueError(identification.refusal)
        model_folder.mkdir(exist_ok=True)
        identification.write_model(model_folder)
        write_robot(
            identified_robot(identification, load_config(model_folder / "config.yaml")), model_folder / "robot.yaml"
        )
    return str(model_folder / "config.yaml")


def measure(config, make_plant, trajectory, oracle):
    """Yield, per direction, the number of drives inside, and width, oracle's width and maximum error [mm]."""
    predicted = predict_by_drives(config, trajectory, own_plant(config))
    reference, settings = load_reference(drive_case(config, trajectory, own_plant(config), 0)), load_config(config)
    plants = (make_plant(_SEED + seed, sample_time=settings.sample_time) for seed in range(_DRIVES + oracle))
    runs = (simulate(Controller(settings), plant, reference) for plant in plants)
    errors = np.array([absolute_errors(run, len(predicted.time)) for run in runs])
    widths = [predicted.lateral.everywhere, predicted.along.everywhere]
    np.savez(Path(config).with_name(f"{trajectory}.npz"), errors=errors, widths=widths)
    for width, rows in zip(widths, errors.swapaxes(0, 1), strict=True):
        oracle_width = tube(rows[_DRIVES:], settings.sample_time).everywhere.mean() if oracle else np.nan
        yield np.count_nonzero((rows[:_DRIVES] <= width).all(axis=1))
        yield from (1e3 * np.array([width.mean(), oracle_width, rows.max()])).round(2)


def main(folder, names, oracle):
    """Measure the robots, and write a row for each path."""
    folder.mkdir(exist_ok=True)
    with (folder / "rows.csv").open("a") as file:
        for name in names:
            robot_folder = folder / name.replace(":", "-")
            robot_folder.mkdir(exist_ok=True)
            kind, _, number = name.partition(":")
            make_plant, number = partial(FOREIGN[kind], int(number)), int(number)
            for index, structure in ((number, "sm"), (number + 2, "ssm")):
                for path in (_PATHS[index % 5], _PATHS[(index + 1) % 5]):
                    trajectory = f"spline-{330200 + number}" if path == "spline" else path
                    try:
                        row = measure(
                            identify_robot(robot_folder, make_plant, structure), make_plant, trajectory, oracle
                        )
                        cells = [*row]
                    except ValueError as error:
                        cells = [f"no tube: {error}".replace(",", ";")]
                    print(name, structure, trajectory, *cells, sep=",", file=file, flush=True)


if __name__ == "__main__":
    arguments = sys.argv[1:]
    count = int(arguments.pop(arguments.index("--oracle") + 1)) if "--oracle" in arguments else 0
    out, *robots = (argument for argument in arguments if argument != "--oracle")
    main(Path(out), robots, count)
