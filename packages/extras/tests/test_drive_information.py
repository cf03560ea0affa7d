"""Prediction of the deviations that a drive gives a velocity model."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures.model_file import build_model
from diffdrive_mpc.models.structures.sm import SmFile, identify_sm
from diffdrive_mpc.sim.plants.open_loop import random_commands
from diffdrive_mpc_extras.excitation.drive_information import TOLD, DriveInformation

DT = 0.02
NOISE = np.array([0.01, 0.02])
CHANNELS = {
    "v": {"gain": 0.9, "natural_frequency": 14.0, "damping": 1.1},
    "omega": {"gain": 0.7, "natural_frequency": 20.0, "damping": 0.9},
}
ORIGIN = {"name": "truth", "structure": "sm", "provenance": {"origin": "assumed", "source": "this test"}}
DEAD_TIME = {"v": 0.05, "omega": 0.03}
SM = build_model(SmFile.model_validate(ORIGIN | {"dead_time": DEAD_TIME, "channels": CHANNELS}))


def steps(seed, seconds):
    return random_commands(seed, smooth=False, duration=seconds, sample_time=DT)


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_laws_of_information(seed):
    """Deviations go with the noise and, for the same drive four times over, with one over two."""
    commands = np.vstack([steps(seed, 20.0), np.zeros((100, 2))])
    once = DriveInformation(SM, NOISE).parameters(commands, DT)
    louder = DriveInformation(SM, 3 * NOISE).parameters(commands, DT)
    # The prior of the second time constant is not scaled with the noise: a few per cent.
    assert louder.standard_deviation == pytest.approx(3 * once.standard_deviation, rel=0.1)
    four = DriveInformation(SM, NOISE).parameters(np.tile(commands, (4, 1)), DT)
    assert four.standard_deviation == pytest.approx(once.standard_deviation / 2, rel=0.1)
    longer = DriveInformation(SM, NOISE).parameters(np.vstack([commands, steps(seed + 1, 5.0)]), DT)
    assert (longer.standard_deviation <= once.standard_deviation * (1 + 1e-6)).all()


@pytest.mark.parametrize("name", ["mbm", "ssm"])
def test_other_structures_by_gain_and_mean_delay(name):
    model = load_linear_model(name)
    estimate = DriveInformation(model, NOISE).parameters(steps(1, 10.0), DT)
    for row, channel in enumerate(("v", "omega")):
        assert estimate.value(f"{channel}.gain") == pytest.approx(model.dc_gain[row, row])
        delay = estimate.value(f"{channel}.lag") + estimate.value(f"{channel}.dead_time")
        assert delay == pytest.approx(model.lag[row], rel=1e-6)


def test_errors_of_identification_are_as_large_as_stated():
    """Ten logs of one robot, each with noise of its own: errors over stated deviations are of size one."""
    commands = steps(5, 25.0)
    stated = DriveInformation(SM, NOISE).parameters(commands, DT)
    sampled = SM.discretise(DT)
    state, clean = np.zeros(SM.order), np.zeros(commands.shape)
    line = np.vstack([np.zeros((int(sampled.delay.max()) + 1, 2)), commands])
    first = len(line) - len(commands)
    for k in range(len(commands)):
        clean[k] = sampled.C @ state
        recent = np.array([line[first + k - d, j] for j, d in enumerate(sampled.delay)])
        older = np.array([line[first + k - d - 1, j] for j, d in enumerate(sampled.delay)])
        state = sampled.A @ state + sampled.B0 @ recent + sampled.B1 @ older
    errors = []
    for seed in range(10):
        read = clean + NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
        record = Record("drive", 0.0, DT, commands, twist=read, yaw_rate=read[:, 1])
        identified = identify_sm([record], limits=False).parameters
        for channel in ("v", "omega"):
            part = {name: identified.value(f"{channel}.{name}") for name in ("gain", "dead_time")}
            part["lag"] = 2 * identified.value(f"{channel}.damping") / identified.value(f"{channel}.natural_frequency")
            named = [(f"{channel}.{name}", part[name]) for name in TOLD]
            errors.append([(value - stated.value(name)) / stated.deviation(name) for name, value in named])
    # The root mean square of 10 normal values has a deviation of 0.22: within three of them.
    size = np.sqrt(np.mean(np.reshape(errors, (10, 6)) ** 2, axis=0))
    assert (size > 0.5).all(), size
    assert (size < 1.6).all(), size
