"""Measure the tubes of `predict-error` on robots of foreign physics: excite, identify, predict, and drive.

    python packages/extras/tests/tubes_of_foreign_robots.py FOLDER tyres:10 belts:11 castors:12

Each robot drives its path six times, "s" with an odd seed and a drawn spline with an even one. FOLDER keeps logs,
models and errors. With `--oracle N` it drives N times, and their tube is the oracle's.
"""

import sys
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

_DRIVES, _DRAWS, _SEED = 6, 40, 9000


def identified(folder, make, structure="sm"):
    """Drive a robot for 120 s in 6 by 6 m, and write model, configuration and robot of the log; return the second."""
    excitation = excite_model("ssm", Room(6.0, 6.0), seconds=120.0, seed=7)
    path, log = folder / "excitation.yaml", folder / "log.csv"
    excitation.write(path)
    config = load_config("ssm")
    run = simulate(Controller(config), make(7), load_trajectory(path, config))
    check_drive(run, excitation.room)
    with run_log(log) as write:
        write(run, excitation.case)
    identification = identify([log], structure=structure)
    if identification.refusal:
        raise ValueError(identification.refusal)
    identification.write_model(folder)
    write_robot(identified_robot(identification, load_config(folder / "config.yaml")), folder / "robot.yaml")
    return str(folder / "config.yaml")


def measure(folder, kind, robot, drives):
    """Print the drives inside both tubes of one robot, and widths in mm."""

    def make(seed):
        return FOREIGN[kind](robot, seed)

    config = identified(folder, make)
    trajectory = "s" if robot % 2 else f"spline-{330200 + robot}"
    predicted = predict_by_drives(config, trajectory, own_plant(config), _DRAWS)
    reference, loaded = load_reference(drive_case(config, trajectory, own_plant(config), 0)), load_config(config)
    runs = (simulate(Controller(loaded), make(_SEED + seed), reference) for seed in range(drives))
    errors = np.array([absolute_errors(run, len(predicted.time)) for run in runs])
    np.savez(folder / "errors.npz", errors=errors)
    for number, direction in enumerate(("lateral", "along")):
        width, driven = getattr(predicted, direction).everywhere, errors[:, number]
        oracle = tube(driven, loaded.sample_time).everywhere.mean() if drives > _DRAWS else np.nan
        inside = np.count_nonzero((driven <= width).all(axis=1))
        sys.stdout.write(
            f"{kind}:{robot} {trajectory} {direction}: {inside} of {drives} inside, width {1e3 * width.mean():.1f} mm, "
            f"largest error {1e3 * driven.max():.1f} mm, oracle {1e3 * oracle:.1f} mm\n"
        )


if __name__ == "__main__":
    arguments = sys.argv[1:]
    count = int(arguments.pop(arguments.index("--oracle") + 1)) if "--oracle" in arguments else _DRIVES
    out, *robots = (argument for argument in arguments if argument != "--oracle")
    for name in robots:
        part = Path(out) / name.replace(":", "-")
        part.mkdir(parents=True, exist_ok=True)
        try:
            measure(part, name.partition(":")[0], int(name.partition(":")[2]), count)
        except ValueError as error:
            sys.stdout.write(f"{name}: no tube: {error}\n")
