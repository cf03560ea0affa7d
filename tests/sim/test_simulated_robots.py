"""Robots of the `mujoco` plant that differ from the twin: what mechanics says of each, and what mistakes give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import ConfigError, make_plant
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.named_file import shipped_names
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.simulated_robot import ROBOTS, load_simulated_robot

SHIPPED = shipped_names(ROBOTS)
GRAVITY = 9.81


def _plant(name: str, surface: str = "default") -> MujocoPlant:
    plant = make_plant(f"mujoco:{name}", surface, "perfect")
    assert isinstance(plant, MujocoPlant)
    return plant


def _hold(name: str, v: float, omega: float, samples: int = 150) -> OpenLoopDrive:
    return drive_open_loop(_plant(name), np.tile([v, omega], (samples, 1)))


def _resting_loads(name: str) -> FloatArray:
    plant = _plant(name)
    for _ in range(50):
        plant.advance([0.0, 0.0])
    return plant.chassis.wheel_loads


@pytest.mark.parametrize("name", SHIPPED)
def test_the_floor_carries_its_weight_where_its_centre_of_mass_is(name: str) -> None:
    """Balance of forces and moments: front left, front right, rear left, rear right."""
    build = load_simulated_robot(name)
    loads = _resting_loads(name)
    assert loads.sum() == pytest.approx(build.robot.mass * GRAVITY, rel=1e-3)
    ahead = build.twin.chassis.wheel_base / 2 * np.array([1, 1, -1, -1])
    left = build.robot.track / 2 * np.array([1, -1, 1, -1])
    # It leans by the deflection of its tyres, which moves the mass above by less than a millimetre.
    np.testing.assert_allclose(
        [loads @ ahead / loads.sum(), loads @ left / loads.sum()], build.twin.chassis.centre_of_mass, atol=1e-3
    )


def test_a_file_that_changes_nothing_is_the_twin_bit_for_bit(tmp_path: Path) -> None:
    path = tmp_path / "same.yaml"
    path.write_text("description: the same\n")
    commands = random_commands(7, duration=2.0)
    one, other = (drive_open_loop(make_plant(name, seed=3), commands) for name in ("mujoco", f"mujoco:{path}"))
    for name in OpenLoopDrive.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("name", [name for name in SHIPPED if name.startswith("dead_time")])
def test_nothing_moves_before_the_dead_time(name: str) -> None:
    dead_time = load_simulated_robot(name).twin.link.dead_time
    assert name == f"dead_time_{1e3 * dead_time:.0f}"
    log = _hold(name, 0.6, 0.0, 15)
    moving = np.abs(log.true_twist[:, 0]) > 1e-3
    assert not moving[log.time <= dead_time].any()
    assert moving[log.time > dead_time + load_robot().sample_time].all()


def test_wheels_that_are_too_slow_stay_below_the_speed_of_the_shipped_paths() -> None:
    reachable = load_simulated_robot("short_of_speed").twin.motor.no_load_speed * load_robot().wheel_radius
    v = _hold("short_of_speed", 0.5, 0.0).wheel_twist[:, 0]
    assert v.max() <= reachable * (1 + 1e-3) < 0.5
    assert v[-1] == pytest.approx(reachable, rel=0.02)


def test_a_weak_side_falls_behind_while_the_motors_give_all_they_have() -> None:
    """At full duty the strong side pulls ahead: the twin, whose motors differ by 3 % at most, turns much less."""
    turned = [abs(_hold(name, 1.5, 0.0, 12).true_pose[-1, 2]) for name in ("weak_side_20", "heavy")]
    assert _hold("weak_side_20", 1.5, 0.0, 12).true_pose[-1, 2] > 0
    assert turned[0] > 3 * turned[1]


@pytest.mark.parametrize(("name", "quicker"), [("slow_motors", False), ("quick_motors", True)])
def test_motors_answer_slower_or_faster_than_the_twin(name: str, quicker: bool) -> None:
    """Time until 63 % of a step of v, and of omega."""
    for v, omega, channel in ((0.5, 0.0, 0), (0.0, 0.8, 2)):
        logs = [drive_open_loop(plant, np.tile([v, omega], (100, 1))) for plant in (_plant(name), make_plant("mujoco"))]
        rates = [log.true_twist[:, channel] / log.true_twist[-1, channel] for log in logs]
        rise = [
            float(np.interp(0.63, np.maximum.accumulate(rate), log.time)) for rate, log in zip(rates, logs, strict=True)
        ]
        assert (rise[0] < rise[1]) == quicker


@pytest.mark.parametrize("name", ["long", "long_naive", "wide", "wide_naive"])
def test_another_build_turns_on_the_spot_as_coulomb_friction_and_its_firmware_say(name: str) -> None:
    """Wheels turn at firmware track / track of what is told, the body at track^2 / (track^2 + wheel base^2) of that."""
    build = load_simulated_robot(name)
    track, base = build.robot.track, build.twin.chassis.wheel_base
    told = build.firmware.track / track * track**2 / (track**2 + base**2)
    turned = _hold(name, 0.0, 0.8).true_twist[75:, 2].mean() / 0.8
    assert turned == pytest.approx(told, abs=0.03)
    assert (abs(turned - 1.0) < 0.03) == (not name.endswith("naive"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "twin: {chassis: {wheelbase: 0.2}}",
            "unknown key 'twin.chassis.wheelbase'; did you mean 'twin.chassis.wheel_base'?",
        ),
        ("robot: {mass: -1.0}", "robot.mass: Input should be greater than 0 (found -1.0)"),
        ("robot: {mass: 0.5}", "robot.mass 0.5 kg: its wheels alone weigh 1 kg"),
        ("twin: {chassis: {centre_of_mass: [0.1, 0.0]}}", "it must lie between the wheels, 0.07 m ahead and 0.165 m"),
        ("twin: {motor: {spread: [1.0, 1.0]}}", "twin.motor.spread"),
        ("twin: 3", "twin: Input should be a valid dictionary"),
        ("wheels: {track: 0.3}", "unknown key 'wheels'"),
    ],
)
def test_a_mistake_gives_one_line_that_names_the_place(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"description: mine\n{text}\n")
    with pytest.raises(ConfigError) as caught:
        make_plant(f"mujoco:{path}")
    assert message in str(caught.value)
    assert "mine.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_robot_needs_a_description_and_a_name_that_exists(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("robot: {mass: 8.0}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: key 'description' is missing$"):
        make_plant(f"mujoco:{path}")
    with pytest.raises(ConfigError, match=r"unknown robot 'heavi': give one of .*; did you mean 'heavy'\?$"):
        make_plant("mujoco:heavi")
