"""Expected standard deviations of a velocity model identified from a drive."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures.model_file import build_model
from diffdrive_mpc.models.structures.sm import SmFile, identify_sm
from diffdrive_mpc_extras.excitation.drive_information import REPORTED, DriveInformation
from studies.open_loop import random_commands

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
def test_standard_deviations_scale_with_noise_and_duration(seed):
    """Deviations are proportional to the noise, and half as large for four repetitions of a drive."""
    commands = np.vstack([steps(seed, 20.0), np.zeros((100, 2))])
    single = DriveInformation(SM, NOISE).parameters(commands, DT)
    noisy = DriveInformation(SM, 3 * NOISE).parameters(commands, DT)
    # The prior of the second time constant does not scale with the noise, which causes differences of a few per cent.
    assert noisy.standard_deviation == pytest.approx(3 * single.standard_deviation, rel=0.1)
    repeated = DriveInformation(SM, NOISE).parameters(np.tile(commands, (4, 1)), DT)
    assert repeated.standard_deviation == pytest.approx(single.standard_deviation / 2, rel=0.1)
    longer = DriveInformation(SM, NOISE).parameters(np.vstack([commands, steps(seed + 1, 5.0)]), DT)
    assert (longer.standard_deviation <= single.standard_deviation * (1 + 1e-6)).all()


@pytest.mark.parametrize("name", ["mbm", "ssm"])
def test_parameters_of_other_structures_match_gain_and_mean_delay(name):
    model = load_linear_model(name)
    estimate = DriveInformation(model, NOISE).parameters(steps(1, 10.0), DT)
    for row, channel in enumerate(("v", "omega")):
        assert estimate.value(f"{channel}.gain") == pytest.approx(model.dc_gain[row, row])
        delay = estimate.value(f"{channel}.lag") + estimate.value(f"{channel}.dead_time")
        assert delay == pytest.approx(model.lag[row], rel=1e-6)


def test_identification_errors_agree_with_the_expected_deviations():
    """Compare the errors in ten logs with independent noise to the expected standard deviations."""
    commands = steps(5, 25.0)
    expected = DriveInformation(SM, NOISE).parameters(commands, DT)
    sampled = SM.discretise(DT)
    state, outputs = np.zeros(SM.order), np.zeros(commands.shape)
    history = np.vstack([np.zeros((int(sampled.delay.max()) + 1, 2)), commands])
    first = len(history) - len(commands)
    for k in range(len(commands)):
        outputs[k] = sampled.C @ state
        recent = np.array([history[first + k - d, j] for j, d in enumerate(sampled.delay)])
        previous = np.array([history[first + k - d - 1, j] for j, d in enumerate(sampled.delay)])
        state = sampled.A @ state + sampled.B0 @ recent + sampled.B1 @ previous
    errors = []
    for seed in range(10):
        readings = outputs + NOISE * np.random.default_rng(seed).standard_normal(outputs.shape)
        record = Record("drive", 0.0, DT, commands, twist=readings, yaw_rate=readings[:, 1])
        identified = identify_sm([record], limits=False).parameters
        for channel in ("v", "omega"):
            values = {name: identified.value(f"{channel}.{name}") for name in ("gain", "dead_time")}
            values["lag"] = (
                2 * identified.value(f"{channel}.damping") / identified.value(f"{channel}.natural_frequency")
            )
            parameters = [(f"{channel}.{name}", values[name]) for name in REPORTED]
            errors.append([(value - expected.value(name)) / expected.deviation(name) for name, value in parameters])
    # The RMS of 10 standard normal values has a standard deviation of 0.22.
    rms = np.sqrt(np.mean(np.reshape(errors, (10, 6)) ** 2, axis=0))
    assert (rms > 0.5).all(), rms
    assert (rms < 1.6).all(), rms
