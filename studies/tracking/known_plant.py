"""Plant data for the clairvoyant controller: a velocity model fitted to the true motion, and the slip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.structures.channel import identify_channel
from diffdrive_mpc.models.structures.model_file import side_by_side
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim.plants.make import make_plant
from diffdrive_mpc.sim.plants.surface import load_surface
from studies.open_loop import OpenLoopDrive, drive_open_loop

_PERFECT = "perfect"
_MODEL_PREFIX = "model:"
_REST_DURATION = 1.0
"""Duration of the rest before each drive [s]; it must be longer than the response of the robot."""


@dataclass(frozen=True)
class KnownPlant:
    """Linear model and slip coefficients of a plant.

    Attributes
    ----------
    model
        Model from commands to the true (v, omega), including dead time.
    side_slip, load_shift
        Coefficients [s, s^2] of the lateral speed `omega (load_shift dv/dt - side_slip v)`. The robot slips outwards in
        steady turns. It slips inwards while it accelerates, because load on the rear wheels moves the centre of
        rotation back.
    """

    model: VelocityModel
    side_slip: float
    load_shift: float


@cache
def identify_plant(plant: str, surface: str, trajectories: tuple[str, ...]) -> KnownPlant:
    """Identify model and slip of a plant.

    A plant that is a velocity model is known exactly. A physics plant is driven in open loop with the twists of
    `trajectories` as commands, and two-pole models are fitted to its true motion. The bound is evaluated on the same
    trajectories.

    Parameters
    ----------
    plant, surface
        Names as in `sim.plants.make`; the name of a "model:" plant must not contain a dead time.
    trajectories
        Names or paths of trajectories.

    Raises
    ------
    models.checked_yaml.ConfigError, ValueError
        If a name is unknown, or if the trajectories do not excite both channels.
    """
    if plant.startswith(_MODEL_PREFIX):
        return _exact_plant(load_linear_model(plant.removeprefix(_MODEL_PREFIX)), surface)
    logs = [reference_drive(plant, surface, trajectory) for trajectory in trajectories]
    # The true motion has no outliers, and the references do not exceed the limits of the robot.
    fits = [
        identify_channel(_experiments(logs, channel, output), name, limit=False, robust=False)
        for name, channel, output in (("v", 0, 0), ("omega", 1, 2))
    ]
    A, B, C = side_by_side([fit.form.file(**fit.content) for fit in fits])
    dead_time = np.array([fit.parameters.value("dead_time") for fit in fits])
    model = VelocityModel(f"{plant} on {surface}", "sm", A, B, C, dead_time)
    side_slip, load_shift = _fit_slip(logs)
    return KnownPlant(model, side_slip, load_shift)


def _exact_plant(model: VelocityModel, surface: str) -> KnownPlant:
    slip = load_surface(surface).slip
    gains = np.array([[slip.longitudinal_gain], [slip.yaw_gain]])
    scaled_model = VelocityModel(model.name, model.structure, model.A, model.B, gains * model.C, model.dead_time)
    return KnownPlant(scaled_model, slip.side_slip, 0.0)


def reference_drive(plant: str, surface: str, trajectory: str) -> OpenLoopDrive:
    """Drive a plant with perfect sensors in open loop; the commands are the twists of the reference."""
    robot, reference = make_plant(plant, surface, _PERFECT), load_trajectory(trajectory)
    return drive_open_loop(robot, reference.sample(np.arange(0.0, reference.duration, robot.sample_time)).twist)


def _experiments(logs: list[OpenLoopDrive], channel: int, output: int) -> list[SampledExperiment]:
    """Build experiments that start with a period at rest, which determines the unknown initial state."""
    experiments = []
    for log in logs:
        if np.ptp(log.command[:, channel]) > 0:
            dt = float(log.time[1] - log.time[0])
            padding = ((round(_REST_DURATION / dt), 0), (0, 0))
            signals = (log.command[:, [channel]], log.true_twist[:, [output]])
            command, motion = (np.pad(signal, padding) for signal in signals)
            experiments.append(SampledExperiment("reference", dt, command, motion, np.ones(motion.shape, dtype=bool)))
    return experiments


def _fit_slip(logs: list[OpenLoopDrive]) -> tuple[float, float]:
    """Fit side-slip [s] and load shift [s^2] by least squares."""
    regressors, lateral_speeds = [], []
    for log in logs:
        v, lateral_speed, omega = log.true_twist.T
        regressors.append(np.column_stack([-v * omega, np.gradient(v, log.time) * omega]))
        lateral_speeds.append(lateral_speed)
    side_slip, load_shift = np.linalg.lstsq(np.vstack(regressors), np.concatenate(lateral_speeds), rcond=None)[0]
    return float(side_slip), float(load_shift)
