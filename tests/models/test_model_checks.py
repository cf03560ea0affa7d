"""What cannot be a robot is refused on load, in one line that names place and remedy."""

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError, ModelError, VelocityModel, load_model
from diffdrive_mpc.models.load import PARAMETERS

GOOD = yaml.safe_load((PARAMETERS / "ssm.yaml").read_text())


def write(tmp_path, **changes):
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({**GOOD, **changes}))
    return path


def one_line(error):
    assert "\n" not in str(error.value)
    return str(error.value)


def test_unstable_model(tmp_path):
    with pytest.raises(ModelError, match="unstable") as error:
        load_model(write(tmp_path, A=[[7.381, 0.3359], [-1.104, -13.31]]))
    assert "model.yaml" in one_line(error)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_model_that_is_not_finite(tmp_path, value):
    with pytest.raises((ModelError, ConfigError), match="finite"):
        load_model(write(tmp_path, A=[[value, 0.3359], [-1.104, -13.31]]))
    with pytest.raises(ModelError, match="finite"):
        VelocityModel("x", "ssm", np.full((2, 2), value), np.eye(2), np.eye(2))


def test_degrees_are_noticed(tmp_path):
    C = np.array(GOOD["C"])
    C[1] *= 180 / np.pi
    with pytest.raises(ModelError, match="omega.*units"):
        load_model(write(tmp_path, C=C.tolist()))


def test_a_channel_with_the_wrong_sign_is_noticed(tmp_path):
    C = np.array(GOOD["C"])
    C[1] *= -1
    with pytest.raises(ModelError, match="sign"):
        load_model(write(tmp_path, C=C.tolist()))


def test_poles_in_other_units_are_noticed(tmp_path):
    A, B = np.array(GOOD["A"]) * 1e3, np.array(GOOD["B"]) * 1e3
    with pytest.raises(ModelError, match="rad/s"):
        load_model(write(tmp_path, A=A.tolist(), B=B.tolist()))


def test_dead_time_in_milliseconds_is_noticed(tmp_path):
    with pytest.raises(ModelError, match="dead time"):
        load_model(write(tmp_path, dead_time={"v": 40.0, "omega": 40.0}))


def test_wrong_shape(tmp_path):
    with pytest.raises(ModelError, match="shape"):
        load_model(write(tmp_path, B=[[0.65], [0.05]]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"structure": "gru"}, "structure"),
        ({"dead_tme": {"v": 0.1}}, "did you mean 'dead_time'"),
        ({"name": None}, "name"),
        ({"A": [[1.0], [1.0, 2.0]]}, "rows of equal length"),
    ],
)
def test_mistakes_in_the_file(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_model(write(tmp_path, **changes))
    one_line(error)


def test_a_key_given_twice(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("name: a\nname: b\n")
    with pytest.raises(ConfigError, match="line 2: key 'name' is given twice"):
        load_model(path)


def test_yaml_executes_nothing(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(f"structure: !!python/object/apply:pathlib.Path.touch [{tmp_path / 'touched'}]\n")
    with pytest.raises(ConfigError):
        load_model(path)
    assert not (tmp_path / "touched").exists()
