"""Shipped values are reproduced: calibration of the firmware, and identification of known parameters."""

import numpy as np
import pytest

from diffdrive_mpc import make_plant
from diffdrive_mpc.sim.plants.twin_parameters import load_firmware
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import drive_open_loop, random_commands
from studies.shipped_models.calibration import PredictionFit, load_calibration_parameters, validate_calibration
from studies.shipped_models.known_truths import recover_all

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def fits() -> list[PredictionFit]:
    return validate_calibration()


def test_published_model_predicts_the_plant_on_held_out_drives(fits: list[PredictionFit]) -> None:
    required = load_calibration_parameters().required_fit
    smooth = [fit for fit in fits if fit.smooth]
    assert len(smooth) == 2
    for fit in smooth:
        assert fit.v >= required.v
        assert fit.omega >= required.omega


def test_firmware_file_states_the_fit_of_the_plant(fits: list[PredictionFit]) -> None:
    rows = load_firmware().provenance["held_out_fit_percent"]
    for row, fit in zip(rows, fits, strict=True):
        assert (row["seed"], row["smooth"]) == (fit.seed, fit.smooth)
        assert (row["v"], row["omega"]) == pytest.approx((fit.v, fit.omega), abs=0.1)


def test_stated_encoder_noise_equals_that_of_the_counting_encoders() -> None:
    """The sensor set changes measurements, not physics, so `perfect` gives the true values for `default`."""
    commands = random_commands(9, smooth=False)
    noisy, exact = (drive_open_loop(make_plant("mujoco", sensors=name), commands) for name in ("default", "perfect"))
    np.testing.assert_array_equal(noisy.true_pose, exact.true_pose)
    is_settled = np.ones(len(commands), dtype=bool)
    for change in np.flatnonzero(np.any(np.diff(commands, axis=0, prepend=0.0) != 0, axis=1)):
        is_settled[change : change + 25] = False
    error = (noisy.wheel_speeds - exact.wheel_speeds)[is_settled]
    assert error.std() == pytest.approx(load_sensor_set("default").encoders.speed_sd, rel=0.15)
    assert abs(error.mean()) < 0.2 * error.std()


@pytest.mark.long
def test_true_parameters_are_within_four_standard_deviations():
    progress = []
    recoveries = recover_all(6, lambda count, total: progress.append((count, total)))
    assert progress == [(i, 6) for i in range(1, 7)]
    scores = np.concatenate([recovery.standardised_errors for recovery in recoveries])
    assert np.abs(scores).max() < 4.0
    # Deviations that are much too large would pass the previous check.
    assert 0.6 < np.sqrt(np.mean(scores**2)) < 1.5
