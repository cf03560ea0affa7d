"""Configuration keys: synonyms, sections, former names and fixed values."""

from __future__ import annotations

import pytest
import yaml

from diffdrive_mpc import ConfigError, ControllerConfig, load_config
from diffdrive_mpc.models.errors import UnusualValueWarning
from diffdrive_mpc.models.logs.mapping import LogMapping
from diffdrive_mpc.models.suggestions import SYNONYMS, suggestion
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.described import commented_yaml, schema_rows
from diffdrive_mpc.mpc.config.fixed_values import fixed_values
from diffdrive_mpc.mpc.config.former_keys import current_place
from diffdrive_mpc.mpc.config.rooms import USER, is_for_users, merge_sections, plain_key, shown_key
from diffdrive_mpc.mpc.problem.slip import CURVED_SLIPS


@pytest.mark.parametrize("key", sorted(SYNONYMS))
def test_every_synonym_suggests_a_key(key):
    suggestions = [suggestion(schema, [key]) for schema in (ControllerConfig, LogMapping)]
    assert any(name in hint for name in SYNONYMS[key] for hint in suggestions), suggestions


def test_model_file_is_found_next_to_the_configuration(tmp_path):
    (tmp_path / "mine.yaml").write_text("anything")
    (tmp_path / "c.yaml").write_text("model: mine.yaml\n")
    assert load_config(tmp_path / "c.yaml").model == str(tmp_path / "mine.yaml")


def test_every_key_is_in_one_section_and_user_keys_come_first():
    keys = [row.key for row in schema_rows()]
    user_keys = [key for key in keys if not key.startswith("expert.")]
    assert keys[: len(user_keys)] == user_keys
    assert [key for key in user_keys if not is_for_users(plain_key(key))] == []
    assert all(shown_key(plain_key(key)) == key for key in keys)
    assert all(
        any(key == section or key.startswith((f"{section}.", f"{section}[]")) for key in user_keys) for section in USER
    )


def test_constants_are_not_keys():
    assert not fixed_values().keys() & {plain_key(row.key) for row in schema_rows()}


def test_file_with_former_keys_is_read(tmp_path):
    path = tmp_path / "old.yaml"
    path.write_text(
        "model: sm\nestimator: {min_gain: 0.2, history: 0.5, crab_drift: 0.01}\nreentry: {max_look_ahead: 1.4}\n"
    )
    config = load_config(path)
    assert (config.estimator.history, config.reentry.max_look_ahead) == (0.5, 1.4)
    assert config.estimator.crab == [0.0, 0.0, 0.01]
    path.write_text(commented_yaml(config))
    assert load_config(path) == config


def test_constants_are_accepted_with_their_values_only():
    groups: dict[str, dict[str, float]] = {}
    for key, value in fixed_values().items():
        group, _, name = key.partition(".")
        groups.setdefault(group, {})[name] = value
        assert getattr(getattr(ControllerConfig(), group), name) == value
        with pytest.raises(ConfigError, match=f"{key}: .* differs from the constant {value} in .*remove it"):
            load_config("sm", {key: 1.5 * value})
        assert current_place(key) == f"the constant {key} in mpc/config/fixed_values.yaml"
    assert load_config({"model": "sm", **groups}) == load_config({"model": "sm"})


def test_former_keys_set_entries_of_the_list_of_curved_slip():
    overrides = {"estimator.veer": -0.1, "estimator.veer_uncertainty": 0.02}
    config = load_config("sm", overrides)
    assert config.estimator.veer == [-0.1, 0.02, 0.0]
    assert replace_values(config, {"estimator.veer_drift": 0.3}).estimator.veer == [-0.1, 0.02, 0.3]
    slip = config.estimator
    assert [slip.start("veer"), slip.uncertainty("veer"), slip.drift("veer")] == config.estimator.veer
    assert {name for name, field in type(slip).model_fields.items() if isinstance(field.default, list)} == set(
        CURVED_SLIPS
    )


def test_keys_are_accepted_with_and_without_expert():
    both_forms = [{"expert.estimator.history": 0.5}, {"estimator.history": 0.5}]
    assert [load_config("ssm", overrides).estimator.history for overrides in both_forms] == [0.5, 0.5]
    assert load_config({"model": "ssm", "expert": {"estimator": {"history": 0.5}}}).estimator.history == 0.5


def test_commented_yaml_contains_every_key():
    config = ControllerConfig()
    assert merge_sections(yaml.safe_load(commented_yaml(config))) == config.model_dump()


def test_yaw_rate_limit_in_degrees_gives_a_warning():
    with pytest.warns(UnusualValueWarning, match="omega = 90 rad/s is 14.3 turns a second; if it is in degrees, give"):
        load_config("ssm", {"limits.omega": 90.0})


def test_repr_contains_only_values_that_differ_from_defaults():
    assert "limits=Limits(v=1.2)" in repr(load_config("ssm", {"limits.v": 1.2}))
