"""An identified model goes to a file and comes back the same, with what is known about it."""

import datetime

import numpy as np
import pytest
import yaml
from identification_parts import noisy_drive, published_ssm

from diffdrive_mpc import ConfigError, load_model
from diffdrive_mpc.models.load import read_model_file
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.structures.identified import model_file, write_model_file
from diffdrive_mpc.models.structures.mbm import identify_mbm
from diffdrive_mpc.models.structures.sm import identify_sm
from diffdrive_mpc.models.structures.ssm import identify_ssm

DRIVE = noisy_drive(published_ssm(), 21, count=1500, limit=0.9)
WHEELS = DRIVE.twist @ np.array([[1.0, 1.0], [-0.2, 0.2]]) / 0.07
WITH_WHEELS = Record("wheels", 0.0, DRIVE.dt, DRIVE.command, twist=DRIVE.twist, yaw_rate=DRIVE.yaw_rate, wheels=WHEELS)
IDENTIFY = {
    "mbm": lambda: identify_mbm([WITH_WHEELS], 0.07),
    "sm": lambda: identify_sm([DRIVE]),
    "ssm": lambda: identify_ssm([DRIVE], 2),
}


def written(identified, path):
    content = model_file(
        identified,
        name="test",
        source="test log",
        records=["drive"],
        date=datetime.date(2026, 1, 2),
        train_fit_percent=np.array([91.234, 85.0]),
        validation_fit_percent=np.array([90.0, 84.0]),
    )
    write_model_file(path, content)
    return path


@pytest.mark.parametrize("structure", IDENTIFY)
def test_the_loaded_model_is_the_identified_one(structure, tmp_path):
    identified = IDENTIFY[structure]()
    path = written(identified, tmp_path / "model.yaml")
    loaded = load_model(path)
    for name in ("A", "B", "C", "dead_time"):
        assert getattr(loaded, name).tolist() == getattr(identified.model, name).tolist()
    assert loaded.structure == structure
    assert loaded.provenance["date"] == "2026-01-02"
    assert "omega of the gyro" in loaded.provenance["method"]
    data = read_model_file(path)
    assert data.fit_percent.v == 91.23
    assert data.validation_fit_percent.omega == 84.0
    known = data.uncertainty
    assert known.parameters == list(identified.parameters.names)
    deviation = np.array(known.standard_deviation)
    covariance = np.outer(deviation, deviation) * known.correlation
    scale = np.outer(identified.parameters.standard_deviation, identified.parameters.standard_deviation)
    assert np.abs(covariance - identified.parameters.covariance).max() < 1e-3 * scale.max()
    assert data.warnings == [str(doubt) for doubt in identified.warnings]


def test_a_limit_found_stands_in_the_file(tmp_path):
    data = read_model_file(written(IDENTIFY["ssm"](), tmp_path / "model.yaml"))
    assert data.limits.omega == pytest.approx(0.9, abs=0.02)
    assert data.limits.v is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"limits": {"omega": -1.0}}, "limits.omega"),
        (
            {"uncertainty": {"parameters": ["a"], "value": [], "standard_deviation": [1.0], "correlation": [[1.0]]}},
            "each",
        ),
    ],
)
def test_mistakes_in_the_new_keys_are_named(change, message, tmp_path):
    path = written(IDENTIFY["sm"](), tmp_path / "model.yaml")
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **change}))
    with pytest.raises(ConfigError, match=message):
        load_model(path)
