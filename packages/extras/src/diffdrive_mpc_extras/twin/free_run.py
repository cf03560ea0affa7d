"""The plant driven by a log's commands alone, and the readings that the log's sensors would have had."""

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

_AT_REST = np.array([0.02, 0.05])
"""Readings [m/s, rad/s] below which a robot counts as standing."""
_UNCOUNTED = 1e6
"""Encoder pulses a revolution that are as good as an angle."""
_FEWEST = 5
"""Readings of each sensor in a window."""


@dataclass(frozen=True)
class LogStretch:
    """Some rows of a log that the plant is driven along.

    Attributes
    ----------
    experiment
        The rows that count.
    lead
        (n, 2) commands before them that are driven, too.
    before
        (2,) command under which the robot is settled before all of these.
    """

    experiment: SampledExperiment
    lead: FloatArray
    before: FloatArray


def stretch(run: SampledExperiment, first: int, stop: int, dc_gain: FloatArray) -> LogStretch:
    """Cut rows `first` up to `stop` of a run without gaps; `dc_gain` (2, 2) of the identified model gives its start."""
    settings = twin_settings()
    rows = slice(first, stop)
    part = SampledExperiment(run.name, run.dt, run.inputs[rows], run.outputs[rows], run.counts[rows])
    if first > 0:
        lead = run.inputs[max(0, first - round(settings.lead / run.dt)) : first]
        return LogStretch(part, lead, lead[0])
    reading = np.array([run.outputs[np.argmax(run.counts[:, row]), row] for row in (0, -1)])
    moving = np.abs(reading) > _AT_REST
    return LogStretch(part, np.empty((0, 2)), np.asarray(np.linalg.solve(dc_gain, np.where(moving, reading, 0.0))))


def most_telling(runs: Sequence[SampledExperiment], dc_gain: FloatArray, seconds: float) -> list[LogStretch]:
    """Select at most `seconds` of windows in which the commands change most, in the order of the log."""
    commands = np.concatenate([run.inputs for run in runs])
    scale = np.maximum(commands.std(axis=0), 1e-12)
    span = max(2, round(twin_settings().window / runs[0].dt))
    places = [(i, k) for i, run in enumerate(runs) for k in range(0, run.samples, span)]
    lengths = [min(span, runs[i].samples - k) for i, k in places]
    changes = [
        float((np.abs(np.diff(runs[i].inputs[k : k + span], axis=0)) / scale).sum()) / n
        for (i, k), n in zip(places, lengths, strict=True)
    ]
    left = round(seconds / runs[0].dt)
    taken: list[tuple[int, int, int]] = []
    for place in np.argsort(-np.array(changes), kind="stable").tolist():
        (i, k), count = places[place], lengths[place]
        if (runs[i].counts[k : k + count].sum(axis=0) >= _FEWEST).all() and (count <= left or not taken):
            taken.append((i, k, k + count))
            left -= count
    return [stretch(runs[i], first, stop, dc_gain) for i, first, stop in sorted(taken)]


@dataclass(frozen=True)
class FreeMotion:
    """Motion of the plant along one stretch, at `parts` instants a sample.

    Attributes
    ----------
    parts
        Instants in a sample; the first is that of the sample.
    wheels
        (n, 2) v [m/s], omega [rad/s] by its encoders.
    body
        (n, 3) true forward and lateral speed [m/s], yaw rate [rad/s].
    lead
        Rows before the first sample that counts.
    """

    parts: int
    wheels: FloatArray
    body: FloatArray
    lead: int

    def twist(self) -> FloatArray:
        """Return the twist (K, 3) of the body at the samples."""
        return self.body[self.lead :: self.parts]


def drive(robot: SimulatedRobot, stretches: Sequence[LogStretch]) -> list[FreeMotion]:
    """Drive the plant along stretches of one sample time, each from settled motion.

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
        # The wheels as the drivers see them, which is a little late, without counting: it would be noise in slopes.
        perfect.model_copy(update={"encoders": Encoders(speed_sd=1.0)}),
        robot=robot.robot.model_copy(update={"encoder_pulses": _UNCOUNTED}),
        twin=robot.twin,
        firmware=robot.firmware,
        base=robot.base,
        sample_time=dt / parts,
    )
    return [_drive(plant, stretch_of_log, parts) for stretch_of_log in stretches]


def _drive(plant: MujocoPlant, along: LogStretch, parts: int) -> FreeMotion:
    plant.reset(np.zeros(3))
    settled = round(twin_settings().settle / plant.sample_time) if along.before.any() else 0
    rows = np.concatenate([np.tile(along.before, (settled, 1)), np.repeat(along.lead, parts, axis=0)])
    commands = np.concatenate([rows, np.repeat(along.experiment.inputs, parts, axis=0)])
    wheels, body = np.empty((len(commands), 2)), np.empty((len(commands), 3))
    for k, command in enumerate(commands):
        twist = plant.measure().wheel_twist
        assert twist is not None
        wheels[k], body[k] = twist.value, plant.true_twist
        plant.advance(command)
    return FreeMotion(parts, wheels, body, len(rows))


def readings(motion: FreeMotion, experiment: SampledExperiment, sensors: Values) -> FloatArray:
    """Compute v and omega (K, p) of the log's encoders and, for p = 3, omega of its gyro."""
    step = experiment.dt / motion.parts
    measured = motion.wheels
    if "encoders_lag" in sensors:
        keep = float(np.exp(-step / sensors["encoders_lag"]))
        half = 0.5 * (1 - keep)
        measured = measured[0] + signal.lfilter([half, half], [1.0, -keep], measured - measured[0], axis=0)
    samples = motion.lead + motion.parts * np.arange(experiment.samples)
    instants, fine = samples - sensors.get("encoders_delay", 0.0) / step, np.arange(len(measured))
    columns = [np.interp(instants, fine, column) for column in measured.T]
    if experiment.outputs.shape[1] > len(columns):
        columns.append(motion.body[samples, 2] + sensors.get("gyro_offset", 0.0))
    return np.column_stack(columns)
