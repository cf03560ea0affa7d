"""Torques of the simulated robot in steady turns and on the diagnostic drive, and its own least radius."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.disturbances.scenario import Scenario
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop
from diffdrive_mpc.sim.plants.simulated_robot import load_simulated_robot
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from diffdrive_mpc_extras.energy.power_readings import READINGS, Battery, PowerReadings, power_sensor
from diffdrive_mpc_extras.turn_costs import DriveConstants
from diffdrive_mpc_extras.turn_costs.least_radius import LIMIT_SHARE
from studies.torque.settings import Diagnostic, Measured, Unseen, load_study

KEPT_SHARE = 0.90
"""Below this share of the commanded curvature a turn is not kept; whole pulses a second make up to 0.05."""

_BISECTIONS = 9
_WIDEST = 60.0
# A ball in the middle of the body, so that the payload changes the weight alone.
_BALL = 0.03


class Steady(NamedTuple):
    """Steady turns, n radii; means over left and right turns."""

    radius: FloatArray
    """(n,) commanded [m]"""
    outer: FloatArray
    """(n,) [N m]"""
    inner: FloatArray
    """(n,) [N m]"""
    kept: FloatArray
    """(n,) curvature by the wheels over the commanded one [-]"""
    power: FloatArray
    """(n, 2) mechanical power outer, inner [W]"""


def sides(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums of motor rows (n, 4) over the left and over the right side."""
    return rows[:, 0] + rows[:, 2], rows[:, 1] + rows[:, 3]


def plant_of(robot: str, surface: str, payload: float = 0.0, seed: int = 0, sensors: str = "default") -> MujocoPlant:
    """The robot on a floor, with a payload [kg] in the middle of its body.

    Raises ConfigError if robot or floor do not exist, or the floor has no friction.
    """
    build, floor = load_simulated_robot(robot), load_surface(surface)
    if floor.friction is None:
        raise ConfigError(f"surface '{surface}' has no friction; give one for the physics, such as 'grippy'")
    load = None
    if payload:
        ahead, left = build.twin.chassis.centre_of_mass
        ball = {"mass": payload, "x": ahead, "y": left, "z": build.twin.chassis.body_height, "radius": _BALL}
        load = Scenario.model_validate({"description": "payload", "payload": ball})
    return MujocoPlant(
        floor.friction,
        load_sensor_set(sensors),
        seed,
        robot=build.robot,
        twin=build.twin,
        firmware=build.firmware,
        base=build.base,
        scenario=load,
        sideways=floor.sideways,
    )


def diagnostic_drive(plant: MujocoPlant, settings: Diagnostic) -> OpenLoopDrive:
    """The spiral of P4: each radius held, to the left and to the right, the speeds in turn."""
    return drive_open_loop(
        plant, diagnostic_commands(settings.radii, settings.speeds, round(settings.hold / plant.sample_time))
    )


def diagnostic_commands(radii: Sequence[float], speeds: Sequence[float], hold: int, rest: int = 0) -> FloatArray:
    """(n, 2) turns held one after the other for `hold` samples, the speeds in turn, with rest before and after."""
    each = np.resize(speeds, len(radii))
    rows = np.repeat(np.stack([each, each / np.array(radii)], axis=-1), hold, axis=0)
    still = np.zeros((rest, 2))
    return np.concatenate([still, rows, still])


def steady_turns(plant: MujocoPlant, radii: Sequence[float], speed: float, settings: Measured, track: float) -> Steady:
    """Steady turns of these radii, each to both sides from rest.

    Parameters
    ----------
    plant
        The robot.
    radii
        (n,) [m].
    speed
        [m/s].
    settings
        How long each settles and is measured.
    track
        By which the base makes wheel speeds of commands [m].
    """
    before, after = (round(time / plant.sample_time) for time in (settings.settling, settings.hold))
    turns = []
    for radius in radii:
        both = []
        for sign in (1, -1):
            drive = drive_open_loop(plant, np.tile([speed, sign * speed / radius], (before + after, 1)))
            torque, power, wheels = (
                np.array([side[before:].mean() for side in sides(rows)])
                for rows in (drive.motor_torque, drive.motor_power, 0.5 * drive.motor_speed)
            )
            # Outer first: to the left it is the right side.
            torque, power, wheels = torque[::-sign], power[::-sign], wheels[::-sign]
            by_wheels = 2 * (wheels[0] - wheels[1]) / (wheels[0] + wheels[1]) / track
            both.append([*torque, by_wheels * radius, *power])
        turns.append(np.mean(both, axis=0))
    rows = np.array(turns)
    return Steady(np.array(radii), rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3:])


def own_least_radius(
    plant: MujocoPlant, speed: float, settings: Measured, limit: float, track: float
) -> tuple[float, float]:
    """The robot's own least radius [m], by bisection: by torque, and by the turn that is no longer kept.

    By torque: the largest at which the outer side gives 95 % of its limit. Zero where there is none.
    """
    sharpest = 1.05 * 0.5 * track

    def bisected(fails: int) -> float:
        def failed(radius: float) -> bool:
            turn = steady_turns(plant, [radius], speed, settings, track)
            return bool((turn.outer[0] > LIMIT_SHARE * limit, turn.kept[0] < KEPT_SHARE)[fails])

        low, high = sharpest, _WIDEST
        if not failed(low):
            return 0.0
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if failed(middle) else (low, middle)
        return math.sqrt(low * high)

    return bisected(0), bisected(1)


def unseen_commands(settings: Unseen, seed: int, sample_time: float, least: float) -> FloatArray:
    """(n, 2) turns drawn from `seed`, none sharper than 1.2 times the `least` radius [m] at its own speed."""
    rng = np.random.default_rng(seed)
    count, rows = round(settings.hold / sample_time), []
    for _ in range(settings.turns):
        speed = rng.uniform(*settings.speeds)
        low = max(settings.radii[0], 1.2 * least)
        radius = math.exp(rng.uniform(math.log(low), math.log(max(settings.radii[1], 2 * low)))) * rng.choice([-1, 1])
        rows.append([speed, speed / radius])
    levels, since = np.array([[0.0, 0.0], *rows]), np.tile((np.arange(count) + 1) * sample_time, settings.turns)
    # Gently from each to the next, as who saves energy drives.
    share = np.minimum(since / settings.ramp, 1.0)[:, None] if settings.ramp else np.ones((len(since), 1))
    before, after = (np.repeat(part, count, axis=0) for part in (levels[:-1], levels[1:]))
    return np.asarray(before + share * (after - before))


# A drive of the simulated robot whose battery and motors are read once for each of several drive constants.


class TorqueDrive(NamedTuple):
    """What happened, n ticks; the physics does not depend on what is read."""

    dt: float
    command: FloatArray
    speeds: FloatArray
    """(n, 4) as the encoders say [rad/s]"""
    motors: FloatArray
    """(n, steps, 2, 4) in the sample before the tick"""


def driven(plant: MujocoPlant, commands: FloatArray) -> TorqueDrive:
    """Drive, and keep what every motor did in every step."""
    plant.reset(np.zeros(3))
    speeds, motors = [], []
    done = np.zeros_like(plant.motors)
    for command in commands:
        measured = plant.measure().wheel_speeds
        assert measured is not None
        speeds.append(np.asarray(measured.value))
        motors.append(done)
        plant.advance(command)
        done = plant.motors.copy()
    return TorqueDrive(plant.sample_time, commands, np.array(speeds), np.array(motors))


def record(drive: TorqueDrive, constants: DriveConstants, seed: int, battery: Battery | None = None) -> Record:
    """What a log of the drive holds with sensors of power, for a robot with these constants."""
    reads = PowerReadings(power_sensor(), battery or Battery(voltage=16.8, resistance=0.1), constants, seed)
    rows = []
    for motors in drive.motors:
        reads.take(motors)
        rows.append(reads.value)
    read = np.array(rows)
    sides = 0.5 * (drive.speeds[:, :2] + drive.speeds[:, 2:])
    return Record(
        "drive",
        0.0,
        drive.dt,
        drive.command,
        wheels=sides,
        wheel_speeds=drive.speeds,
        battery=read[:, :2],
        motor_current=read[:, 2:4] + read[:, 4:],
        motor_currents=read[:, 2:],
    )


def drawn(usual: DriveConstants, rng: np.random.Generator) -> DriveConstants:
    """Constants of another robot with the same gears: a half to twice, and a computer of 2 to 20 W."""
    torque, resistance = np.exp(rng.uniform(np.log(0.5), np.log(2.0), 2))
    changes = {
        "torque_constant": usual.torque_constant * torque,
        "resistance": usual.resistance * resistance,
        "idle_power": rng.uniform(2.0, 20.0),
        "regeneration": bool(rng.random() < 0.5),
        "driver_efficiency": rng.uniform(0.85, 1.0),
    }
    return usual.model_copy(update=changes)


# The diagnostic drive of the simulated robot as a log with battery and motors, as a real robot would have left it.


_COLUMNS = (
    "t_s",
    "v_ref_m_s",
    "omega_ref_rad_s",
    "v_wheel_m_s",
    "omega_wheel_rad_s",
    *(f"wheel_{wheel}_rad_s" for wheel in ("fl", "fr", "rl", "rr")),
    "omega_gyro_rad_s",
    "pose_t_s",
    *(f"pose_{part}" for part in ("x_m", "y_m", "theta_rad")),
    *READINGS,
)
# Before and after the turns it stands [s]: what is drawn at rest is told by that.
_REST = 3.0


def write_diagnostic_log(robot: str, surface: str, path: str | Path, seed: int = 0) -> None:
    """Drive the turns of the torque study open loop, with rest before and after, and write a CSV log.

    Its columns are those of `simulate --log` that a robot has; sensors are the set `power`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If robot or floor do not exist, or the file cannot be written.
    """
    asked = load_study().diagnostic
    plant = make_plant(f"mujoco:{robot}", surface=surface, sensors="power", seed=seed)
    hold, rest = (round(time / plant.sample_time) for time in (asked.hold, _REST))
    commands = diagnostic_commands(asked.radii, asked.speeds, hold, rest)
    plant.reset(np.zeros(3))
    assert isinstance(plant, MujocoPlant)
    with whole_file(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for command in commands:
            measured = plant.measure()
            parts = [measured.wheel_twist, measured.wheel_speeds, measured.yaw_rate]
            assert all(part is not None for part in parts)
            read = [np.ravel(part.value) for part in parts if part is not None]
            pose = [""] * 4 if measured.pose is None else [measured.pose.time, *np.ravel(measured.pose.value)]
            cells = np.concatenate([[plant.time], command, *read])
            writer.writerow([*map(repr, cells.tolist()), *pose, *map(repr, plant.parts["power"].value.tolist())])
            plant.advance(command)
