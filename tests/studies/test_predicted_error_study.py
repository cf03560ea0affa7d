"""The study of the predicted error: calibration that covers further drives, and reproducible drives."""

import numpy as np
import pytest
import yaml
from studies.predicted_error.calibrate import calibrate_scale, coverage
from studies.predicted_error.drives import DrivenPath, drive, load_study, plan_drives, read_drives, write_drives
from studies.predicted_error.study import PredictedErrorStudy

from diffdrive_mpc.models.checked_yaml import check
from diffdrive_mpc_extras.predicted_error.calibration import FEATURES, ErrorCalibration, load_calibration

TRUE = {"floor": 0.002, "turning": 0.01, "yaw_acceleration": 0.05}
"""Coefficients of artificial drives; an error is their weighted sum times a factor of the drive and noise."""


def artificial_drives(count, seed, wider=1.0):
    stream, drives = np.random.default_rng(seed), []
    row = np.array([TRUE.get(name, 0.0) for name in FEATURES])
    for _ in range(count):
        features = np.abs(np.cumsum(stream.normal(size=(80, len(FEATURES))), axis=0)) / 5.0
        features[:, 0] = 1.0
        scale = wider * stream.lognormal(sigma=0.3) * (features @ row)
        errors = {name: np.abs(stream.normal(size=80)) * scale for name in ("lateral", "along")}
        drives.append(DrivenPath(features, errors, float(stream.uniform(0.2, 0.8)), float(stream.uniform(0.2, 1.0))))
    return drives


@pytest.fixture(scope="module")
def scale():
    return calibrate_scale(artificial_drives(60, 1), artificial_drives(400, 2), "lateral", 0.95)


def test_calibration_covers_other_drives(scale):
    result = coverage(artificial_drives(1000, 3), scale, "lateral")
    assert 0.93 < result.at_each_place < 0.97
    assert 0.92 < result.everywhere.share < 0.98
    assert result.width < result.width_everywhere


def test_scale_depends_on_the_features_that_cause_the_error(scale):
    assert set(TRUE) <= scale.coefficients.keys()
    features = artificial_drives(20, 5)[0].features
    true = features @ np.array([TRUE.get(name, 0.0) for name in FEATURES])
    assert np.corrcoef(features @ scale.row, true)[0, 1] > 0.98


def test_report_states_coverage_and_writes_a_readable_calibration():
    study = load_study(None)
    sets = {name: artificial_drives(30, k) for k, name in enumerate(planned_names(study))}
    report = PredictedErrorStudy(study).report(sets, 1.0)
    assert [len(table.rows) > 0 for table in report.tables] == [True] * 4
    written = check(ErrorCalibration, yaml.safe_load(report.files["calibration.yaml"]), "calibration.yaml")
    assert written.populations.keys() == load_calibration().populations.keys()


def planned_names(study):
    parts = [f"{name}-{part}" for name in study.populations for part in ("fit", "calibration", "test")]
    oracles = [f"{name}-oracle-{seed}" for name in study.populations for seed in study.oracle.paths]
    return [*parts, *study.others, *oracles]


def test_drive_is_reproducible_and_stored_unchanged(tmp_path):
    study = load_study(None, quick=True)
    population = study.populations["drawn"]
    plan = plan_drives(population.fit, population.factors)[0]
    first, second = drive(study, plan), drive(study, plan)
    assert first.errors["lateral"].tobytes() == second.errors["lateral"].tobytes()
    assert first.features.shape == (len(first.errors["along"]), len(FEATURES))
    write_drives([first], tmp_path / "set.npz")
    (stored,) = read_drives(tmp_path / "set.npz")
    np.testing.assert_allclose(stored.errors["lateral"], first.errors["lateral"], rtol=1e-6)
    assert stored.speed == pytest.approx(first.speed)
