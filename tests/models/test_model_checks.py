"""What cannot be a robot is refused on load, in one line that names place and remedy."""

import numpy as np
import pytest
import yaml

from diffdrive_mpc import ConfigError, ModelError, VelocityModel, load_model
from diffdrive_mpc.models.load import PARAMETERS
from refusals import one_line_error

GOOD = yaml.safe_load((PARAMETERS / "ssm.yaml").read_text())


def write(tmp_path, **changes):
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({**GOOD, **changes}))
    return path


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_model_that_is_not_finite(tmp_path, value):
    with pytest.raises((ModelError, ConfigError), match="finite"):
        load_model(write(tmp_path, A=[[value, 0.3359], [-1.104, -13.31]]))
    with pytest.raises(ModelError, match="finite"):
        VelocityModel("x", "ssm", np.full((2, 2), value), np.eye(2), np.eye(2))


def scaled(name, factors):
    """Return a matrix of the good model times a factor, or a factor for each row."""
    return (np.array(GOOD[name]) * np.reshape(factors, (-1, 1))).tolist()


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (ModelError, {"A": [[7.381, 0.3359], [-1.104, -13.31]]}, "model.yaml.*unstable"),
        (ModelError, {"C": scaled("C", [1, 180 / np.pi])}, "omega.*units"),
        (ModelError, {"C": scaled("C", [1, -1])}, "sign"),
        (ModelError, {name: scaled(name, 1e3) for name in "AB"}, "rad/s"),
        (ModelError, {"dead_time": {"v": 40.0, "omega": 40.0}}, "dead time"),
        (ModelError, {"B": [[0.65], [0.05]]}, "shape"),
        (ConfigError, {"structure": "gru"}, "structure"),
        (ConfigError, {"dead_tme": {"v": 0.1}}, "did you mean 'dead_time'"),
        (ConfigError, {"name": None}, "name"),
        (ConfigError, {"A": [[1.0], [1.0, 2.0]]}, "rows of equal length"),
    ],
)
def test_mistakes_in_the_file(tmp_path, kind, changes, message):
    with one_line_error(kind, match=message):
        load_model(write(tmp_path, **changes))


def test_a_key_given_twice(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("name: a\nname: b\n")
    with pytest.raises(ConfigError, match="line 2: key 'name' is given twice"):
        load_model(path)
