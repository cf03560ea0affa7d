"""The torque study: what it measures and predicts, from small drives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from commands import invoke
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc_extras.turn_costs import load_drive_constants, load_vehicle
from studies.cli import app
from studies.torque.measurements import own_least_radius, plant_of, steady_turns, unseen_commands
from studies.torque.outcome import measure_floor, parts_of
from studies.torque.settings import load_study, small

STUDY = load_study()
TRACK, LIMIT = 0.39, 4.6


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The quick study by the command line."""
    out = tmp_path_factory.mktemp("torque")
    invoke(app, "torque", "--quick", "--jobs", "1", "--out", out)
    return out


def test_the_promises_hold_on_one_floor(report: Path) -> None:
    (floor,) = json.loads((report / "torque.json").read_text())["floors"]
    assert floor["prior_rmse"] > 0.5
    assert floor["learned_rmse"] < 0.1
    assert floor["close_after_s"] < 90
    assert floor["model_least_radius_m"] == pytest.approx(floor["own_least_radius_m"], rel=0.2)
    assert floor["own_not_kept_radius_m"] == pytest.approx(floor["own_least_radius_m"], rel=0.3)
    for one in floor["energies"]:
        assert abs(one["error"]) < 0.1


def test_speed_counts_on_tyres_that_creep(report: Path) -> None:
    (floor,) = json.loads((report / "torque.json").read_text())["floors"]
    assert floor["learned_rmse"] < floor["learned_by_radius_rmse"]


def test_a_payload_is_better_known_by_the_terrain_than_by_the_curves(report: Path) -> None:
    empty, loaded = json.loads((report / "torque.json").read_text())["payloads"]
    assert empty["payload_kg"] == 0 and loaded["payload_kg"] == 5
    assert max(loaded["terrain_rmse"]) < 0.8 * max(loaded["as_learned_rmse"])


def test_report_and_figures_are_there(report: Path) -> None:
    names = {path.name for path in (report / "figures").iterdir()}
    assert {"torque-grippy.png", "learned-grippy.png", "power.png", "learning.png", "energy.png"} <= names


def test_without_a_limit_that_meets_there_is_no_least_radius() -> None:
    still = plant_of("fsu_bot", "slippery", sensors="perfect")
    short = STUDY.measured.model_copy(update={"settling": 0.8, "hold": 0.8})
    assert own_least_radius(still, 0.4, short, LIMIT, TRACK) == (0.0, 0.0)


def test_tighter_turns_and_heavier_robots_take_more() -> None:
    short = STUDY.measured.model_copy(update={"settling": 0.8, "hold": 0.8})
    empty, loaded = (
        steady_turns(plant_of("fsu_bot", "slippery", mass, sensors="perfect"), (1.0, 16.0), 0.4, short, TRACK)
        for mass in (0.0, 10.0)
    )
    assert empty.outer[0] > empty.outer[1] > 0 > empty.inner[0]
    # Everything slides in the tight one: what friction asks is in proportion to the weight, drag is not.
    drag = 0.21
    assert (loaded.outer[0] - drag) / (empty.outer[0] - drag) == pytest.approx(27.892 / 17.892, rel=0.05)


def test_unseen_drives_are_gentle_repeatable_and_no_tighter_than_allowed() -> None:
    commands = unseen_commands(STUDY.unseen, 5, 0.02, 2.0)
    assert np.array_equal(commands, unseen_commands(STUDY.unseen, 5, 0.02, 2.0))
    assert not np.array_equal(commands, unseen_commands(STUDY.unseen, 6, 0.02, 2.0))
    assert np.abs(np.diff(commands[:, 0])).max() <= 0.61 * 0.02 / STUDY.unseen.ramp + 1e-9
    held = commands[199::200]
    assert (np.abs(held[:, 0] / held[:, 1]) >= 2.4 - 1e-9).all()


def test_a_floor_without_friction_is_refused() -> None:
    with pytest.raises(ConfigError, match="no friction"):
        plant_of("fsu_bot", "ideal")


def test_quick_is_a_part_of_the_whole() -> None:
    quick = small(STUDY)
    assert {*quick.surfaces} <= {*STUDY.surfaces}
    assert {*quick.measured.radii} <= {*STUDY.measured.radii}
    assert not {*STUDY.fit_radii} & {*STUDY.measured.radii}, "what is fitted is not what it is held against"


@pytest.mark.long
def test_our_own_robot_has_a_vehicle_and_no_least_radius() -> None:
    asked = small(STUDY).model_copy(update={"robot": "default"})
    vehicle, constants = parts_of(asked)
    build = load_simulated_robot("default")
    assert constants == load_drive_constants()
    assert vehicle.mass == pytest.approx(build.robot.mass, rel=1e-3)
    lengths = (vehicle.track, vehicle.wheel_base, vehicle.wheel_radius, vehicle.command_track)
    assert lengths == (build.robot.track, build.twin.chassis.wheel_base, build.robot.wheel_radius, build.firmware.track)
    assert vehicle.torque_limit == 2 * build.twin.motor.stall_torque
    floor = measure_floor(asked, "grippy")
    # It grips with its weight on half its wheel base: far below what its motors have.
    assert floor.own_radius == (0.0, 0.0) and floor.learned_radius == 0.0 and floor.model_radius == 0.0
    (steady,) = floor.steady.values()
    assert steady.outer.max() < 0.5 * vehicle.torque_limit
    assert abs(floor.energies[0].error) < 0.1


def test_a_study_may_name_a_vehicle_of_its_own() -> None:
    vehicle, _ = parts_of(STUDY.model_copy(update={"robot": "heavy", "vehicle": "default"}))
    assert vehicle == load_vehicle("default")
    with pytest.raises(ConfigError, match="unknown vehicle 'heavy'"):
        parts_of(STUDY.model_copy(update={"robot": "heavy"}))
