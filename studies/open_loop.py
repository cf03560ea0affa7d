"""Open-loop drives of a plant with step commands of the papers or random set-points."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray, ReadOnlyArrays
from diffdrive_mpc.models.robot import NotNegative, Positive, Robot, load_robot
from diffdrive_mpc.sim.plants.drivetrain import MotorWork, motor_work, stack
from diffdrive_mpc.sim.plants.plant import Plant


class StepCommands(StrictModel):
    """Parameters of steps from rest to a command level and back to rest."""

    wheel_levels: list[float]
    v_levels: list[float]
    omega_levels: list[float]
    rest_before: NotNegative
    hold: Positive
    rest_after: NotNegative


class RandomCommands(StrictModel):
    """Parameters of random set-points with random durations."""

    v_range: tuple[float, float]
    omega_range: tuple[float, float]
    hold_range: tuple[Positive, Positive]
    smoothing: Positive
    duration: Positive


class CommandParameters(StrictModel):
    """Parameters of the commands of all experiments."""

    steps: StepCommands
    random: RandomCommands


@cache
def load_command_parameters() -> CommandParameters:
    """Read the parameter file of the commands; raise ConfigError if it is invalid."""
    return load_checked(CommandParameters, Path(__file__).with_suffix(".yaml"))


def step_commands(kind: Literal["wheels", "v", "omega"], robot: Robot | None = None) -> list[FloatArray]:
    """Build the commands (K, 2) for each step level: rest, step, rest.

    Parameters
    ----------
    kind
        "wheels": straight motion at the pulse rates of the papers' identification of MBM; "v" and "omega": steps of the
        identification of SM.
    robot
        Robot with wheel radius, encoder and sample time; by default that of the papers.
    """
    robot, steps = robot or load_robot(), load_command_parameters().steps
    metres_per_pulse = 2 * np.pi * robot.wheel_radius / robot.encoder_pulses
    twists = {
        "wheels": [(pulses * metres_per_pulse, 0.0) for pulses in steps.wheel_levels],
        "v": [(v, 0.0) for v in steps.v_levels],
        "omega": [(0.0, omega) for omega in steps.omega_levels],
    }[kind]
    before, hold, after = (round(t / robot.sample_time) for t in (steps.rest_before, steps.hold, steps.rest_after))
    return [np.vstack([np.zeros((before, 2)), np.tile(twist, (hold, 1)), np.zeros((after, 2))]) for twist in twists]


def random_commands(
    seed: int, smooth: bool = True, duration: float | None = None, sample_time: float | None = None
) -> FloatArray:
    """Draw random set-points (K, 2) with random durations, for a drive that starts from rest.

    Parameters
    ----------
    seed
        Seed of set-points and durations.
    smooth
        True to apply a moving average over the last half second; otherwise set-points change in steps.
    duration, sample_time
        Duration and sample time [s]; by default from the parameter file and the robot.
    """
    parameters = load_command_parameters().random
    dt = sample_time or load_robot().sample_time
    count = round((duration or parameters.duration) / dt)
    stream = np.random.default_rng(seed)
    low, high = np.transpose([parameters.v_range, parameters.omega_range])
    rows: list[FloatArray] = []
    while sum(map(len, rows)) < count:
        hold = max(1, round(stream.uniform(*parameters.hold_range) / dt))
        rows.append(np.tile(stream.uniform(low, high), (hold, 1)))
    commands = np.vstack(rows)[:count]
    if not smooth:
        return commands
    window = max(1, round(parameters.smoothing / dt))
    # Moving average by differences of the cumulative sum; before the start the command is zero.
    total = np.cumsum(np.vstack([np.zeros((window, 2)), commands]), axis=0)
    return np.asarray((total[window:] - total[:-window]) / window)


@dataclass(frozen=True, repr=False)
class OpenLoopDrive(ReadOnlyArrays):
    """Open-loop drive of K samples; row k was measured at `time[k]`, immediately before `command[k]` was sent.

    Attributes
    ----------
    time
        (K,) times of the samples [s].
    command
        (K, 2) v_ref [m/s], omega_ref [rad/s].
    wheel_speeds
        (K, 4) measured wheel speeds in the order front left, front right, rear left, rear right [rad/s].
    wheel_twist
        (K, 2) v [m/s], omega [rad/s] from the wheel speeds and the geometric track.
    yaw_rate
        (K,) yaw rate of the gyro [rad/s].
    true_pose
        (K, 3) x [m], y [m], theta [rad, unwrapped].
    true_twist
        (K, 3) forward and lateral speed [m/s], yaw rate [rad/s].
    motor_torque, motor_speed, motor_power, motor_square
        (K, 4) motor work of the sample that starts at `time`, see `sim.plants.drivetrain`; NaN for a plant without
        motors.
    """

    time: FloatArray
    command: FloatArray
    wheel_speeds: FloatArray
    wheel_twist: FloatArray
    yaw_rate: FloatArray
    true_pose: FloatArray
    true_twist: FloatArray
    motor_torque: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_speed: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_power: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    motor_square: FloatArray = field(default_factory=lambda: np.empty((0, 4)))

    @property
    def output(self) -> FloatArray:
        """(K, 2) outputs for a velocity model: v [m/s] of the encoders, omega [rad/s] of the gyro."""
        return np.column_stack([self.wheel_twist[:, 0], self.yaw_rate])


def drive_open_loop(plant: Plant, commands: ArrayLike, pose: ArrayLike = (0.0, 0.0, 0.0)) -> OpenLoopDrive:
    """Reset `plant` to `pose` (3,) and drive it with `commands` (K, 2), one row per sample.

    Raises
    ------
    ValueError
        If a command does not consist of two finite numbers, or encoders or gyro have no reading at a sample.
    """
    rows = np.asarray(commands, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.isfinite(rows).all():
        raise ValueError(f"commands of shape {rows.shape}: give (K, 2) finite numbers, v [m/s] and omega [rad/s]")
    plant.reset(pose)
    count = len(rows)
    time, yaw_rate = np.empty(count), np.empty(count)
    wheel_speeds, wheel_twist = np.empty((count, 4)), np.empty((count, 2))
    true_pose, true_twist = np.empty((count, 3)), np.empty((count, 3))
    work: list[MotorWork] = []
    for k, command in enumerate(rows):
        measurement = plant.measure()
        if measurement.wheel_speeds is None or measurement.wheel_twist is None or measurement.yaw_rate is None:
            raise ValueError(f"no encoders or gyro at {plant.time:.3f} s: use sensors with a reading per sample")
        time[k], true_pose[k], true_twist[k] = plant.time, plant.true_pose, plant.true_twist
        wheel_speeds[k], wheel_twist[k] = measurement.wheel_speeds.value, measurement.wheel_twist.value
        yaw_rate[k] = measurement.yaw_rate.value
        plant.advance(command)
        work.append(motor_work(plant))
    return OpenLoopDrive(time, rows.copy(), wheel_speeds, wheel_twist, yaw_rate, true_pose, true_twist, *stack(work))
