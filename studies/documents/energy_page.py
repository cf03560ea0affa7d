"""Two tables of docs/energy.md: what logs of the simulated robot tell of its motors and turns, beside the truth.

`python -m studies.documents.energy_page` drives, identifies and writes both.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.bench.machine import describe_run
from diffdrive_mpc.bench.study import run_facts
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc_extras.costs_from_log.costs_from_log import learn_log
from diffdrive_mpc_extras.energy import identify_constants
from diffdrive_mpc_extras.energy.power_readings import robot_power
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_turn_costs
from studies.documents.documents import insert
from studies.torque.measurements import diagnostic_commands, drawn, driven, plant_of, record, write_diagnostic_log
from studies.torque.settings import load_study
from studies.torque.study import radius_text

PAGE = Path(__file__).resolve().parents[2] / "docs" / "energy.md"
ROBOT, FLOORS, SEED = "fsu_bot", ("slippery", "default", "carpet", "grippy"), 5
PLACES = (("fsu_bot", "default"), ("fsu_bot", "slippery"), ("default", "default"), ("default", "slippery"))
# Of the logs whose constants are drawn; none was looked at while the identification was built.
SEEDS, SETS = (21, 22, 23), 6
_CONSTANTS = ("torque_constant", "resistance", "idle_power")
_HOLD, _REST = 173, 150
_RADII = np.geomspace(0.6, 200.0, 40)


class EnergyConstants(NamedTuple):
    """What the logs of one robot on one floor tell of its constants, k of them."""

    off: FloatArray
    """(k, 3) errors over the true constants [-]"""
    normalised: FloatArray
    """(k, 3) errors over the deviations that are stated [-]"""
    refused: int


def told(
    robot: str, floor: str, seeds: Sequence[int] = SEEDS, sets: int = SETS, *, all_motors: bool = True
) -> EnergyConstants:
    """Drive the diagnostic turns once a seed, read its battery with drawn constants, and identify them again."""
    asked, off, normalised, refused = load_study().diagnostic, [], [], 0
    usual = robot_power(f"mujoco:{robot}").drive
    for seed in seeds:
        plant, rng = plant_of(robot, floor, seed=seed), np.random.default_rng(seed)
        drive = driven(plant, diagnostic_commands(asked.radii, asked.speeds, _HOLD, _REST))
        for k in range(sets):
            true = drawn(usual, rng)
            log = record(drive, true, seed + 100 * k)
            log = log if all_motors else dataclasses.replace(log, motor_currents=None)
            known = {"regeneration": true.regeneration, "driver_efficiency": true.driver_efficiency}
            try:
                constants = identify_constants([log], usual.model_copy(update=known))
            except ConfigError:
                refused += 1
                continue
            errors = [getattr(constants.constants, name) - getattr(true, name) for name in _CONSTANTS]
            off.append([error / getattr(true, name) for error, name in zip(errors, _CONSTANTS, strict=True)])
            normalised.append(
                [error / constants.deviation[name] for error, name in zip(errors, _CONSTANTS, strict=True)]
            )
    return EnergyConstants(np.array(off).reshape(-1, 3), np.array(normalised).reshape(-1, 3), refused)


def constants_table(seeds: Sequence[int] = SEEDS, sets: int = SETS) -> str:
    """RMS over the logs of each robot on each floor, and of all."""
    lines = [
        "| robot, floor | currents | logs | refused | torque constant [%] | resistance [%] | idle power [%] "
        "| over stated deviations |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for all_motors, currents in ((True, "four"), (False, "the sides'")):
        estimates = [told(*place, seeds, sets, all_motors=all_motors) for place in PLACES]
        rows = [(f"`{robot}`, {floor}", each) for (robot, floor), each in zip(PLACES, estimates, strict=True)]
        every = EnergyConstants(
            np.concatenate([each.off for each in estimates]),
            np.concatenate([each.normalised for each in estimates]),
            sum(each.refused for each in estimates),
        )
        for place, each in [*rows, ("all", every)]:
            cells = [number(100 * value, 1) for value in np.sqrt(np.mean(each.off**2, axis=0))]
            over = number(float(np.sqrt(np.mean(each.normalised**2))), 2)
            lines.append(f"| {place} | {currents} | {len(each.off)} | {each.refused} | {' | '.join(cells)} | {over} |")
    return "\n".join(lines)


def learned_table(floors: Sequence[str] = FLOORS) -> str:
    """What `torque --log` makes of a log beside the turn costs that ship."""
    lines = [
        "| floor | torque constant, off [%] | resistance, off [%] | torques, RMSE [%] | least radius [m] | shipped [m] "
        "| energy of the log, off [%] |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    true = load_drive_constants(ROBOT)
    for floor in floors:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "drive.csv"
            write_diagnostic_log(ROBOT, floor, log, seed=SEED)
            learned = learn_log(log, None, ROBOT, ROBOT)
        shipped = load_turn_costs(f"{ROBOT}-{floor}")
        speed = np.full_like(_RADII, shipped.curve.speed)
        commands = np.stack([speed, speed / _RADII], axis=-1)
        own, others = learned.costs.torques(commands), shipped.torques(commands)
        shares = [
            learned.drive.torque_constant / true.torque_constant - 1,
            learned.drive.resistance / true.resistance - 1,
            float(np.sqrt(np.mean((own - others) ** 2) / np.mean(others**2))),
        ]
        radii = [radius_text(costs.least_radius()) for costs in (learned.costs, shipped)]
        cells = [number(100 * share, 1) for share in shares] + radii
        lines.append(
            f"| {floor} | {' | '.join(cells)} | {number(100 * (learned.predicted / learned.measured - 1), 1)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Write both tables, and of when they are."""
    start = perf_counter()
    parts = {"log-learned": learned_table(), "log-constants": constants_table()}
    parts["log-runs"] = "\n".join(f"* {fact}" for fact in run_facts(describe_run(perf_counter() - start)))
    page = PAGE.read_text(encoding="utf-8")
    for name, text in parts.items():
        page = insert(page, text, name)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
