"""The shipped calibration on drives that it has not seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.calibration import DriveFit, load_calibration_parameters, validate_calibration, write_firmware
from sim.drives import random_drive
from sim.log import record
from sim.make import make_plant
from sim.sensor_set import load_sensor_set
from sim.twin_parameters import load_firmware


@pytest.fixture(scope="module")
def fits() -> list[DriveFit]:
    return validate_calibration()


def test_published_model_predicts_the_plant_on_held_out_drives(fits: list[DriveFit]) -> None:
    required = load_calibration_parameters().required_fit
    smooth = [fit for fit in fits if fit.smooth]
    assert len(smooth) == 2
    for fit in smooth:
        assert fit.v >= required.v
        assert fit.omega >= required.omega


def test_file_states_the_fit_that_the_plant_has(fits: list[DriveFit]) -> None:
    stated = load_firmware().provenance["held_out_fit_percent"]
    for row, fit in zip(stated, fits, strict=True):
        assert (row["seed"], row["smooth"]) == (fit.seed, fit.smooth)
        assert (row["v"], row["omega"]) == pytest.approx((fit.v, fit.omega), abs=0.1)


def test_calibration_and_validation_share_no_drive() -> None:
    parameters = load_calibration_parameters()
    assert not set(parameters.seeds) & set(parameters.held_out_seeds)


def test_calibrated_values_lie_inside_their_bounds() -> None:
    firmware, bounds = load_firmware(), load_calibration_parameters().bounds
    for name in type(bounds).model_fields:
        low, high = getattr(bounds, name)
        assert low < getattr(firmware, name) < high, name


def test_stated_encoder_noise_is_that_of_the_counting_encoders() -> None:
    """The sensor set changes what is delivered and not the physics, so `perfect` shows the truth behind `default`."""
    commands = random_drive(9, smooth=False)
    estimated, true = (record(make_plant("mujoco", sensors=name), commands) for name in ("default", "perfect"))
    np.testing.assert_array_equal(estimated.true_pose, true.true_pose)
    settled = np.ones(len(commands), dtype=bool)
    for change in np.flatnonzero(np.any(np.diff(commands, axis=0, prepend=0.0) != 0, axis=1)):
        settled[change : change + 25] = False
    error = (estimated.wheel_speeds - true.wheel_speeds)[settled]
    assert error.std() == pytest.approx(load_sensor_set("default").encoders.speed_sd, rel=0.15)
    assert abs(error.mean()) < 0.2 * error.std()


def test_written_firmware_reads_back_the_same(tmp_path: Path) -> None:
    write_firmware(load_firmware(), tmp_path / "firmware.yaml")
    assert load_firmware(tmp_path / "firmware.yaml") == load_firmware()
