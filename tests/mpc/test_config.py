"""The configuration: shipped defaults load, and every mistake gives one line with place and remedy."""

import pytest
from pydantic import BaseModel

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig


@pytest.mark.parametrize("name", ["mbm", "sm", "ssm"])
def test_shipped_configurations_load(name):
    assert load_config(name).model == name


def fields(schema, prefix=""):
    for name, field in schema.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from fields(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field


@pytest.mark.parametrize(("key", "field"), list(fields(ControllerConfig)))
def test_every_field_says_what_it_is_and_in_which_unit(key, field):
    assert field.description, key
    if field.annotation is not str or key == "model":
        assert field.description.endswith("]"), key


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"horizn": 20}, "unknown key 'horizn'; did you mean 'horizon'"),
        ({"weights.acros": 1.0}, "did you mean 'weights.across'"),
        ({"across": 1.0}, "did you mean 'weights.across'"),
        ({"weights.across": -1.0}, "weights.across: .*greater than or equal to 0.*-1.0"),
        ({"horizon": 0}, "horizon: .*greater than or equal to 1"),
        ({"horizon": 2.5}, "horizon: .*integer"),
        ({"sample_time": 0}, "sample_time: .*greater than"),
        ({"limits.v": float("nan")}, "limits.v: .*finite"),
        ({"limits.v": float("inf")}, "limits.v: .*finite"),
        ({"limits": 3}, "limits: "),
        ({"horizon.steps": 3}, "'horizon' holds one value"),
        ({"model": ""}, "model: "),
    ],
)
def test_mistakes_are_one_line_with_place_and_remedy(overrides, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_config("ssm", overrides)
    assert "\n" not in str(error.value)


def test_unknown_source():
    with pytest.raises(ConfigError, match="unknown configuration 'smm': give one of mbm, sm, ssm or"):
        load_config("smm")


@pytest.mark.parametrize("text", ["", "- 1\n", "just words"])
def test_a_file_without_keys(tmp_path, text):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="expected keys"):
        load_config(path)


def test_a_model_file_is_found_beside_the_configuration(tmp_path):
    (tmp_path / "mine.yaml").write_text("anything")
    (tmp_path / "c.yaml").write_text("model: mine.yaml\n")
    assert load_config(tmp_path / "c.yaml").model == str(tmp_path / "mine.yaml")
