"""The configuration: shipped defaults load, and every mistake gives one line with place and remedy."""

import pytest
from pydantic import BaseModel

from diffdrive_mpc import ConfigError, ControllerConfig, load_config, load_model, load_trajectory
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.suggestions import SYNONYMS, suggestion


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
        ({"weights.lateral": 1.0}, "did you mean 'weights.across'\\?$"),
        ({"longitudinal": 1.0}, "did you mean 'weights.along'\\?$"),
        ({"weights.yaw": 1.0}, "did you mean 'weights.heading' or 'weights.omega'\\?$"),
        ({"limits.yaw_slew": 1.0}, "did you mean 'limits.omega_slew'\\?$"),
        ({"Q": 1.0}, "did you mean 'weights.along', 'weights.across' or 'weights.heading'\\?$"),
        ({"weights.R": 1.0}, "'weights.v', 'weights.omega', 'weights.v_increment' or 'weights.omega_increment'\\?$"),
        ({"dt": 0.05}, "did you mean 'sample_time'\\?$"),
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


@pytest.mark.parametrize("key", sorted(SYNONYMS))
def test_every_word_of_the_field_leads_to_a_key(key):
    hints = [suggestion(schema, [key]) for schema in (ControllerConfig, LogMapping)]
    assert any(name in hint for name in SYNONYMS[key] for hint in hints), hints


def test_unknown_source():
    shipped = "kinematic, lstm, mbm, p2_experimental, p2_physical, sm, ssm"
    with pytest.raises(ConfigError, match=f"unknown configuration 'smm': give one of {shipped} or"):
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


@pytest.mark.parametrize("make", [load_config, load_trajectory, load_model])
def test_a_name_too_long_for_a_file_is_refused_like_any_other(make):
    with pytest.raises(ConfigError, match="unknown"):
        make("a" * 5000)
