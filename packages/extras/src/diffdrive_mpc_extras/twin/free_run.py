"""Free runs of the plant from the commands of a log, and the simulated readings of the log's sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant
from diffdrive_mpc.sim.plants.simulated_robot import SimulatedRobot
from diffdrive_mpc.sim.sensing.sensor_set import Encoders, load_sensor_set
from diffdrive_mpc_extras.twin.settings import twin_settings
from diffdrive_mpc_extras.twin.space import Values

_REST_LIMITS = np.array([0.02, 0.05])
"""Readings [m/s, rad/s] below which a robot counts as standing."""
_FINE_PULSES = 1e6
"""Encoder pulses per revolution with a negligible quantisation."""
_MIN_READINGS = 5
"""Minimum number of readings of each sensor in a window."""


@dataclass(frozen=True)
class LogStretch:
    """Section of a log for a free run of the plant.

    Attributes
    ----------
    experiment
        Rows that are compared with the plant.
    lead
        (n, 2) commands v [m/s], omega [rad/s] that the plant executes before these rows.
    settling_command
        (2,) command under which the plant settles before `lead`.
    """

    experiment: SampledExperiment
    lead: FloatArray
    settling_command: FloatArray


def cut_stretch(run: SampledExperiment, first: int, stop: int, dc_gain: FloatArray) -> LogStretch:
    """Cut rows `first` up to `stop` of a run without gaps; `dc_gain` (2, 2) maps steady commands to readings."""
    settings = twin_settings()
    rows = slice(first, stop)
    part = SampledExperiment(run.name, run.dt, run.inputs[rows], run.outputs[rows], run.counts[rows])
    if first > 0:
        lead = run.inputs[max(0, first - round(settings.lead / run.dt)) : first]
        return LogStretch(part, lead, lead[0])
    reading = np.array([run.outputs[np.argmax(run.counts[:, row]), row] for row in (0, -1)])
    moving = np.abs(reading) > _REST_LIMITS
    return LogStretch(part, np.empty((0, 2)), np.asarray(np.linalg.solve(dc_gain, np.where(moving, reading, 0.0))))


def most_active_windows(runs: Sequence[SampledExperiment], dc_gain: FloatArray, seconds: float) -> list[LogStretch]:
    """Select the windows with the largest command changes, in log order, up to a total duration of `seconds` [s]."""
    commands = np.concatenate([run.inputs for run in runs])
    scale = np.maximum(commands.std(axis=0), 1e-12)
    span = max(2, round(twin_settings().window / runs[0].dt))
    starts = [(i, k) for i, run in enumerate(runs) for k in range(0, run.samples, span)]
    lengths = [min(span, runs[i].samples - k) for i, k in starts]
    changes = [
        float((np.abs(np.diff(runs[i].inputs[k : k + span], axis=0)) / scale).sum()) / n
        for (i, k), n in zip(starts, lengths, strict=True)
    ]
    budget = round(seconds / runs[0].dt)
    selected: list[tuple[int, int, int]] = []
    for window in np.argsort(-np.array(changes), kind="stable").tolist():
        (i, k), count = starts[window], lengths[window]
        if (runs[i].counts[k : k + count].sum(axis=0) >= _MIN_READINGS).all() and (count <= budget or not selected):
            selected.append((i, k, k + count))
            budget -= count
    return [cut_stretch(runs[i], first, stop, dc_gain) for i, first, stop in sorted(selected)]


@dataclass(frozen=True)
class FreeMotion:
    """Motion of the plant along one stretch, with `parts` rows per sample of the log.

    Attributes
    ----------
    parts
        Number of rows per sample; the first row is at the time of the sample.
    wheels
        (n, 2) v [m/s] and omega [rad/s] of the plant's encoders.
    body
        (n, 3) true forward and lateral speed [m/s], yaw rate [rad/s].
    lead
        Number of rows before the first compared sample.
    """

    parts: int
    wheels: FloatArray
    body: FloatArray
    lead: int

    def twist(self) -> FloatArray:
        """Return the twist (K, 3) of the body at the samples."""
        return self.body[self.lead :: self.parts]


def drive(robot: SimulatedRobot, stretches: Sequence[LogStretch]) -> list[FreeMotion]:
    """Simulate the plant along stretches with a common sample time, each from a settled motion.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot tips over or diverges.
    """
    settings = twin_settings()
    dt = stretches[0].experiment.dt
    parts = int(np.ceil(dt / settings.longest_hold - 1e-9))
    assert robot.friction is not None
    perfect = load_sensor_set("perfect")
    plant = MujocoPlant(
        robot.friction,
        # Wheel speeds of the motor drivers, slightly delayed; quantisation would be noise in finite differences.
        perfect.model_copy(update={"encoders": Encoders(speed_sd=1.0)}),
        robot=robot.robot.model_copy(update={"encoder_pulses": _FINE_PULSES}),
        twin=robot.twin,
        firmware=robot.firmware,
        base=robot.base,
        sample_time=dt / parts,
    )
    return [_drive_stretch(plant, stretch, parts) for stretch in stretches]


def _drive_stretch(plant: MujocoPlant, stretch: LogStretch, parts: int) -> FreeMotion:
    plant.reset(np.zeros(3))
    settling_rows = round(twin_settings().settle / plant.sample_time) if stretch.settling_command.any() else 0
    settling = np.tile(stretch.settling_command, (settling_rows, 1))
    lead = np.concatenate([settling, np.repeat(stretch.lead, parts, axis=0)])
    commands = np.concatenate([lead, np.repeat(stretch.experiment.inputs, parts, axis=0)])
    wheels, body = np.empty((len(commands), 2)), np.empty((len(commands), 3))
    for k, command in enumerate(commands):
        twist = plant.measure().wheel_twist
        assert twist is not None
        wheels[k], body[k] = twist.value, plant.true_twist
        plant.advance(command)
    return FreeMotion(parts, wheels, body, len(lead))


def sensor_readings(motion: FreeMotion, experiment: SampledExperiment, sensors: Values) -> FloatArray:
    """Compute v [m/s] and omega [rad/s] (K, p) of the log's encoders and, for p = 3, omega of its gyro.

    `sensors` may contain "encoders_lag" [s], "encoders_delay" [s] and "gyro_offset" [rad/s].
    """
    step = experiment.dt / motion.parts
    wheels = motion.wheels
    if "encoders_lag" in sensors:
        pole = float(np.exp(-step / sensors["encoders_lag"]))
        gain = 0.5 * (1 - pole)
        wheels = wheels[0] + signal.lfilter([gain, gain], [1.0, -pole], wheels - wheels[0], axis=0)
    samples = motion.lead + motion.parts * np.arange(experiment.samples)
    instants, rows = samples - sensors.get("encoders_delay", 0.0) / step, np.arange(len(wheels))
    columns = [np.interp(instants, rows, column) for column in wheels.T]
    if experiment.outputs.shape[1] > len(columns):
        columns.append(motion.body[samples, 2] + sensors.get("gyro_offset", 0.0))
    return np.column_stack(columns)
