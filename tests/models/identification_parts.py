"""Drives with known parameters, for tests of the identification."""

import numpy as np
import pytest

from diffdrive_mpc import Controller, load_config
from diffdrive_mpc.models import VelocityModel, load_model
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.state_space import LinearSystem

DT = 0.02


def set_points(seed, count, scale, hold=40):
    """Draw (count, len(scale)) random levels, each held for `hold` samples."""
    levels = np.random.default_rng(seed).uniform(-1, 1, (-(-count // hold), len(scale)))
    return np.repeat(levels, hold, axis=0)[:count] * scale


def published_ssm(dead_time=(0.043, 0.052)):
    return load_model("ssm").with_extra_dead_time(dead_time)


def system(model):
    return LinearSystem(model.A, model.B, model.C, model.dead_time, np.zeros(2), np.full((2, 4), np.inf))


def record(commands, twist, name="drive", start=0.0, **more):
    return Record(name, start, DT, commands, twist=twist, yaw_rate=twist[:, 1].copy(), **more)


def noisy_drive(model, seed, count=3000, noise=(0.01, 0.03), limit=np.inf):
    """Simulate one record of `model` with white noise on both sensors; the robot clips |omega_ref| at `limit`."""
    commands = set_points(seed, count, (0.8, 1.5))
    applied = commands.copy()
    applied[:, 1] = np.clip(applied[:, 1], -limit, limit)
    clean = model.discretise(DT).simulate(applied)
    return record(commands, clean + np.array(noise) * np.random.default_rng(seed + 1000).normal(size=clean.shape))


def two_channels(v, omega, dead_time=(0.05, 0.03)):
    """Build a velocity model of two decoupled channels (gain, natural frequency, damping)."""
    A, B, C = np.zeros((4, 4)), np.zeros((4, 2)), np.zeros((2, 4))
    for row, (gain, w, damping) in enumerate((v, omega)):
        rows = slice(2 * row, 2 * row + 2)
        A[rows, rows] = [[0.0, w], [-w, -2 * damping * w]]
        B[2 * row + 1, row], C[row, 2 * row] = gain * w, 1.0
    return VelocityModel("truth", "sm", A, B, C, np.array(dead_time))


def data_of(*records):
    """Return data with the first record for training and the others for validation."""
    return LogData(tuple(records[:1]), tuple(records[1:]), ("made up",), "nothing", "gyro", (), ())


def differences(function, point, step=1e-6):
    """Return the Jacobian of a function at a point by central differences."""
    moves = step * np.eye(len(point))
    ends = [(np.ravel(function(point + move)), np.ravel(function(point - move))) for move in moves]
    return np.column_stack([(high - low) / (2 * step) for high, low in ends])


def check_written(result, folder, tolerance, structure=None):
    """Check that the files of an identification contain its model and define a controller; return the model."""
    result.write(folder)
    model, config = load_model(folder / "model.yaml"), load_config(folder / "config.yaml")
    commands = np.repeat(np.random.default_rng(0).uniform(-1, 1, (4, 2)), 20, axis=0)
    assert model.simulate(commands) == pytest.approx(result.model.simulate(commands), abs=tolerance)
    assert config.sample_time == model.dt
    assert Controller(config).model.structure == model.structure
    assert result.report.as_json()["model"] == (structure or model.structure)
    return model


def single(inputs, outputs):
    return SampledExperiment("one", DT, inputs, outputs, np.ones(outputs.shape, dtype=bool))
