"""`diffdrive-mpc torque`: drive constants, torque curves and slip law from a log."""

import json
from pathlib import Path

import numpy as np
import pytest

from commands import call
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_extras.costs_from_log.costs_from_log import learn_log
from diffdrive_mpc_extras.torque.measurements import write_diagnostic_log
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_turn_costs

SLIPPERY = load_turn_costs("fsu_bot-slippery")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of the simulated robot on a slippery surface."""
    path = tmp_path_factory.mktemp("log") / "drive.csv"
    write_diagnostic_log("fsu_bot", "slippery", path, seed=17)
    return path


@pytest.fixture(scope="module")
def results(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of the command, started from drive constants that differ from the robot's."""
    folder = tmp_path_factory.mktemp("torque")
    initial = folder / "initial.yaml"
    text = "name: a guess\ntorque_constant: 0.04\ngear_ratio: 49.8\ngear_efficiency: 0.76\nresistance: 1.5\n"
    initial.write_text(text + "motors_per_side: 2\nregeneration: true\nprovenance: a guess\n")
    out = folder / "out"
    call("torque", "--log", log, "--vehicle", "fsu_bot", "--drive", initial, "--out", out)
    return out


def test_torque_identifies_constants_and_curves_of_the_robot(results: Path) -> None:
    true_constants = load_drive_constants("fsu_bot")
    drive, costs = load_drive_constants(results / "drive.yaml"), load_turn_costs(results / "turn-costs.yaml")
    deviations = json.loads((results / "torque.json").read_text())["deviations"]
    for name in ("torque_constant", "resistance", "idle_power"):
        assert abs(getattr(drive, name) - getattr(true_constants, name)) < 4 * deviations[name]
    assert drive.torque_constant == pytest.approx(true_constants.torque_constant, rel=0.03)
    assert costs.drive == drive and costs.vehicle == SLIPPERY.vehicle
    radii = np.geomspace(0.6, 200.0, 40)
    commands = np.stack([np.full_like(radii, 0.4), 0.4 / radii], axis=-1)
    # The shipped curves were learned from the true torques of another drive.
    error = costs.torques(commands) - SLIPPERY.torques(commands)
    assert np.sqrt(np.mean(error**2) / np.mean(SLIPPERY.torques(commands) ** 2)) < 0.05
    assert costs.least_radius() == SLIPPERY.least_radius() == 0.0


def test_slip_law_agrees_with_the_simulated_surface(log: Path) -> None:
    law = learn_log(log, None, "fsu_bot", "fsu_bot").slip
    normalised = (law.coefficients - SLIPPERY.slip.rows) / law.deviations
    assert np.abs(normalised).max() < 5
    commands = np.array([[0.4, 0.3], [0.4, -0.3], [0.2, 0.2], [0.6, 0.1]])
    slip = np.einsum("ij,nj->ni", law.coefficients, np.column_stack([commands, commands.prod(axis=1)]))
    expected = SLIPPERY.twist(commands) - np.column_stack([commands[:, 0], np.zeros(4), commands[:, 1]])
    assert slip == pytest.approx(expected, abs=0.03)


def write_part(log: Path, path: Path, omitted: str = "", rows: slice = slice(None)) -> Path:
    """Write the given rows of the log without the columns whose names start with `omitted`; return the path."""
    lines = [line.split(",") for line in log.read_text().splitlines()]
    columns = [k for k, name in enumerate(lines[0]) if not (omitted and name.startswith(omitted))]
    selected = [lines[0], *lines[1:][rows]]
    path.write_text("\n".join(",".join(line[k] for k in columns) for line in selected) + "\n")
    return path


def test_log_without_motors_or_without_turns_raises_config_error(log: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no motor currents"):
        learn_log(write_part(log, tmp_path / "a.csv", "motor"), None, "fsu_bot", "fsu_bot")
    with pytest.raises(ConfigError, match="steady turns, radii of"):
        learn_log(write_part(log, tmp_path / "b.csv", rows=slice(0, 330)), None, "fsu_bot", "fsu_bot")
