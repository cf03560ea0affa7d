"""Shipped values are reproduced: calibration of the firmware, and identification of known parameters."""

from pathlib import Path

import numpy as np
import pytest

from diffdrive_mpc import load_model, make_plant
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.plants.open_loop import OpenLoopDrive, drive_open_loop, random_commands
from diffdrive_mpc.sim.plants.twin_parameters import Firmware, load_firmware
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.shipped_models.calibration import (
    PredictionFit,
    calibrate,
    load_calibration_parameters,
    validate_calibration,
)
from studies.shipped_models.known_truths import recover_all
from studies.shipped_models.model_fitting import IDENTIFICATIONS, PaperExperiments, fit_models


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
    stated = load_firmware().provenance["held_out_fit_percent"]
    for row, fit in zip(stated, fits, strict=True):
        assert (row["seed"], row["smooth"]) == (fit.seed, fit.smooth)
        assert (row["v"], row["omega"]) == pytest.approx((fit.v, fit.omega), abs=0.1)


def test_stated_encoder_noise_is_that_of_the_counting_encoders() -> None:
    """The sensor set changes measurements, not physics, so `perfect` gives the true values for `default`."""
    commands = random_commands(9, smooth=False)
    estimated, true = (drive_open_loop(make_plant("mujoco", sensors=name), commands) for name in ("default", "perfect"))
    np.testing.assert_array_equal(estimated.true_pose, true.true_pose)
    settled = np.ones(len(commands), dtype=bool)
    for change in np.flatnonzero(np.any(np.diff(commands, axis=0, prepend=0.0) != 0, axis=1)):
        settled[change : change + 25] = False
    error = (estimated.wheel_speeds - true.wheel_speeds)[settled]
    assert error.std() == pytest.approx(load_sensor_set("default").encoders.speed_sd, rel=0.15)
    assert abs(error.mean()) < 0.2 * error.std()


@pytest.fixture
def drives(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Seeds of short drives with a velocity model in place of mujoco."""
    seeds_driven: list[int] = []

    def drive(firmware: Firmware, seed: int, smooth: bool) -> OpenLoopDrive:
        seeds_driven.append(seed)
        plant = make_plant(f"model:ssm+{firmware.lag_v}", surface="ideal", sensors="perfect")
        return drive_open_loop(plant, random_commands(seed, smooth, duration=1.0))

    monkeypatch.setattr("studies.shipped_models.calibration._drive", drive)
    return seeds_driven


def test_calibration_writes_its_result_and_announces_each_evaluation(drives: list[int], tmp_path: Path) -> None:
    announced: list[int] = []
    firmware = calibrate(tmp_path / "firmware.yaml", on_evaluation=lambda: announced.append(len(drives)))
    seeds = load_calibration_parameters().seeds
    assert announced == [len(seeds) * (k + 1) for k in range(sum(seed in seeds for seed in drives) // len(seeds))]
    assert len(announced) > 10
    assert load_firmware(tmp_path / "firmware.yaml") == firmware
    assert [path.name for path in tmp_path.iterdir()] == ["firmware.yaml"]
    # The lag delays this plant but not the target: the smallest lag is best.
    assert firmware.lag_v == pytest.approx(load_calibration_parameters().bounds.lag_v[0], abs=2e-3)


@pytest.mark.long
def test_true_parameters_lie_within_four_standard_deviations():
    done = []
    recoveries = recover_all(6, lambda count, total: done.append((count, total)))
    assert done == [(i, 6) for i in range(1, 7)]
    scores = np.concatenate([recovery.standardised for recovery in recoveries])
    assert np.abs(scores).max() < 4.0
    # Much too large deviations would satisfy the line above.
    assert 0.6 < np.sqrt(np.mean(scores**2)) < 1.5


# `models fit` and `models calibrate`: inputs are checked before the long work, and progress is counted.


FITTING = "studies.shipped_models.model_fitting"


def _step(v: float, omega: float) -> OpenLoopDrive:
    commands: FloatArray = np.vstack([np.zeros((10, 2)), np.tile([v, omega], (100, 1))])
    return drive_open_loop(make_plant("model:ssm", surface="ideal", sensors="perfect"), commands)


@pytest.fixture
def quick_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short experiments with a velocity model."""

    straight, turn = [_step(0.5, 0.0)], [_step(0.0, 1.0)]
    monkeypatch.setattr(f"{FITTING}.run_experiments", lambda: PaperExperiments(straight, straight, turn, []))
    monkeypatch.setattr(f"{FITTING}.validation_table", lambda folder: Table("FIT", ("model",), (("sm",),)))


@pytest.mark.usefixtures("quick_parts")
def test_every_identification_is_announced_with_the_correct_total(tmp_path: Path) -> None:
    counts: list[tuple[int, int]] = []
    fit_models(tmp_path, on_progress=lambda done, total: counts.append((done, total)))
    assert IDENTIFICATIONS == 10
    assert counts == [(k, IDENTIFICATIONS) for k in range(IDENTIFICATIONS + 1)]
    assert load_model(tmp_path / "sm.yaml").order == 4
    assert load_model(tmp_path / "mbm.yaml").order == 8
