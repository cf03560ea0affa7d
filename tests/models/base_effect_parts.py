"""Records of an artificial robot with known base effects."""

import numpy as np
import yaml

from diffdrive_mpc.models.base_effects import BaseEffects, respond
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import PARAMETERS
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures.model_file import SmFile, build_model

DT = 0.05
ENCODER_TRACK = 0.5


def linear_model():
    channel = {"gain": 0.95, "natural_frequency": 14.0, "damping": 1.0}
    data = {
        "name": "made up",
        "structure": "sm",
        "provenance": {"origin": "identified", "source": "a test"},
        "channels": {"v": channel, "omega": {**channel, "gain": 0.57, "natural_frequency": 20.0}},
    }
    return build_model(SmFile.model_validate(data))


def write_effects(path, effects):
    """Write the shipped SM with these base effects."""
    data = yaml.safe_load((PARAMETERS / "sm.yaml").read_text())
    path.write_text(yaml.safe_dump({**data, "base_effects": effects}))
    return path


def step_commands(seed, duration, hold=2.5) -> FloatArray:
    """Return steps of v and omega together, slow and fast, some of which hardly turn one side."""
    stream = np.random.default_rng(seed)
    steps = round(duration / hold)
    v, omega = stream.uniform(-0.8, 0.8, steps), stream.uniform(-3.0, 3.0, steps)
    pivots = stream.uniform(size=steps) < 0.15
    v[pivots] = 0.5 * 0.54 * np.abs(omega[pivots]) * np.sign(v[pivots])
    return np.repeat(np.column_stack([v, omega]), round(hold / DT), axis=0)


def record_of(effects: BaseEffects, seed, duration, *, noise=1.0, yaw_ratio=1.8, delay=0.05, clip=np.inf) -> Record:
    """Simulate encoder (delayed) and gyro (biased) readings of the artificial robot; `noise` scales the default noise.

    The robot clips |omega_ref| at `clip`.
    """
    commands = step_commands(seed, duration)
    applied = np.column_stack([commands[:, 0], np.clip(commands[:, 1], -clip, clip)])
    response = respond(linear_model(), effects, applied, DT)
    stream = np.random.default_rng(seed + 1000)
    time = DT * np.arange(len(commands))
    delayed = np.column_stack([np.interp(time - delay, time, column) for column in response.wheels.T])
    twist = delayed * np.array([1.0, yaw_ratio]) + noise * np.array([0.01, 0.03]) * stream.normal(size=delayed.shape)
    yaw_rate = response.body[:, 1] + 0.02 + noise * 0.015 * stream.normal(size=len(time))
    rim = np.stack(
        [twist[:, 0] - twist[:, 1] * ENCODER_TRACK / 2, twist[:, 0] + twist[:, 1] * ENCODER_TRACK / 2], axis=-1
    )
    return Record(f"seed {seed}", 0.0, DT, commands, twist=twist, yaw_rate=yaw_rate, wheels=rim / 0.16)
