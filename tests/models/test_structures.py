"""A structure is one file: schema, model and identification; an entry in the registry makes it known everywhere."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest
import yaml
from log_parts import drive, write_csv, write_mapping

from diffdrive_mpc.models import identify, load_model
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures import registry
from diffdrive_mpc.models.structures.identified import IdentifiedModel, rounded
from diffdrive_mpc.models.structures.model_file import ModelFile, structure_name
from diffdrive_mpc.models.structures.structure import IdentificationConditions, Structure, StructureFit


class Lag(StrictModel):
    gain: Positive
    time: Positive


class LagsFile(ModelFile):
    """One lag for each channel."""

    structure: Literal["lags"]
    v: Lag
    omega: Lag

    def matrices(self):
        rates = 1 / np.array([self.v.time, self.omega.time])
        return -np.diag(rates), np.diag(rates * [self.v.gain, self.omega.gain]), np.eye(2)


def identify_lags(records: Sequence[Record], conditions: IdentificationConditions) -> StructureFit:
    """Least squares of the change from sample to sample."""
    values = []
    for row in (0, 1):
        outputs = [(r.twist[:, 0], r.yaw_rate)[row] for r in records]
        change = np.concatenate([np.diff(y) for y in outputs])
        pairs = zip(outputs, records, strict=True)
        inputs = np.concatenate([np.column_stack([y[:-1], r.command[:-1, row]]) for y, r in pairs])
        decay, drive = np.linalg.lstsq(inputs, change, rcond=None)[0]
        values += [-drive / decay, -records[0].dt / np.log(1 + decay)]
    names = ("v.gain", "v.time", "omega.gain", "omega.time")
    numbers = dict(zip(names, values, strict=True))
    content = {name: {key: rounded(numbers[f"{name}.{key}"]) for key in ("gain", "time")} for name in ("v", "omega")}
    parameters = ParameterEstimate(names, np.array(values), 1e-6 * np.eye(4))
    model = IdentifiedModel(LagsFile, content, parameters, np.zeros(2), {}, conditions.yaw, "regression", (), ())
    return StructureFit(model)


@pytest.fixture
def lags(monkeypatch):
    """The line in the registry."""
    monkeypatch.setitem(registry.STRUCTURES, "lags", Structure("lags", LagsFile, identify_lags))


@pytest.fixture
def log(tmp_path):
    write_mapping(tmp_path / "map.yaml")
    return write_csv(tmp_path / "drive.csv", drive(seconds=20.0))


def test_a_structure_of_one_s_own_goes_all_the_way(lags, log, tmp_path):
    found = identify(log, tmp_path / "map.yaml", "lags")
    found.write(tmp_path / "mine")
    model = load_model(tmp_path / "mine" / "model.yaml")
    assert model.structure == "lags"
    assert np.diag(model.dc_gain) == pytest.approx([1.0, 1.0], abs=0.02)
    assert model.lag == pytest.approx([0.1, 0.1], abs=0.02)
    assert found.report.fitted.validation.fit_percent.min() > 90.0
    assert "LAGS from drive" in str(found)


def test_only_what_is_registered_is_known(log, tmp_path):
    with pytest.raises(ConfigError, match="structure 'lags': give one of mbm, sm, ssm"):
        identify(log, tmp_path / "map.yaml", "lags")
    content = {"name": "x", "structure": "lags", "provenance": {"origin": "identified", "source": "x"}}
    (tmp_path / "lags.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(
        ConfigError,
        match="structure: expected one of mbm, sm, ssm.*, found 'lags'",
    ):
        load_model(tmp_path / "lags.yaml")


@pytest.mark.parametrize("name", registry.STRUCTURES)
def test_the_registry_calls_each_by_the_name_in_its_files(name):
    structure = registry.STRUCTURES[name]
    assert structure.name == name == structure_name(structure.file)
    assert is_shipped(name)
    assert load_model(name).structure == name


def test_kinematic_is_sm_that_obeys_at_once():
    """Its gains are SM's, it says that nobody measured it, and one sample later nothing is left of the one before."""
    kinematic, sm = load_model("kinematic"), load_model("sm")
    assert kinematic.provenance["origin"] == "assumed"
    np.testing.assert_allclose(kinematic.dc_gain, sm.dc_gain, rtol=1e-12)
    sampled = kinematic.discretise(0.0202)
    assert sampled.delay.tolist() == [0, 0]
    commands = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 0.0]])
    expected = np.vstack([np.zeros(2), commands[:-1] @ kinematic.dc_gain.T])
    np.testing.assert_allclose(sampled.simulate(commands), expected, atol=1e-6)
