"""Parsing of command-line settings `KEY=VALUE` and `KEY=V1,V2,...`."""

from __future__ import annotations

from collections.abc import Sequence

import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError, parse_yaml
from diffdrive_mpc.mpc.config.rooms import plain_key


def parse_setting(text: str) -> tuple[str, list[object]]:
    """Split `KEY=V1,V2,...` into the dotted key and its values.

    Raises ConfigError if the key or the value is missing, or the values are not valid YAML.
    """
    key, equals, value_list = text.partition("=")
    if not equals or not key.strip() or not value_list.strip():
        raise ConfigError(f"--set {text}: write KEY=VALUE or KEY=V1,V2,..., for instance weights.across=100,200")
    try:
        values = parse_yaml(f"[{value_list}]")
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {text}: '{value_list}' is not a list of values separated by commas") from error
    if not values or any(isinstance(value, (list, dict)) for value in values):
        raise ConfigError(f"--set {text}: each value must be a number, a word, true or false; groups have dotted keys")
    if plain_key(key.strip()) == "model":
        raise ConfigError(f"--set {text}: select models with --model (simulate) or --models (bench)")
    return key.strip(), [_to_number(value) for value in values]


def parse_settings(texts: Sequence[str]) -> list[tuple[str, list[object]]]:
    """Parse several settings and return their keys and values in the order of `texts`.

    Raises ConfigError for the reasons of `parse_setting`, and if a key or a value is given twice.
    """
    parsed = [parse_setting(text) for text in texts]
    plain_keys = [plain_key(key) for key, _ in parsed]
    for key, values in parsed:
        if plain_keys.count(plain_key(key)) > 1:
            raise ConfigError(f"--set {key}: given twice; give one value, or with bench a list: {key}=V1,V2")
        if len(set(values)) < len(values):
            raise ConfigError(f"--set {key}: a value is listed twice")
    return parsed


def parse_single_settings(texts: Sequence[str]) -> tuple[tuple[str, object], ...]:
    """Parse settings with one value each, for `simulate`.

    Raises ConfigError for the reasons of `parse_settings`, and if a setting has several values.
    """
    parsed = parse_settings(texts)
    if any(len(values) > 1 for _, values in parsed):
        raise ConfigError("--set: one value per key, decimals with a point; to compare several values use 'bench'")
    return tuple((key, values[0]) for key, values in parsed)


def _to_number(value: object) -> object:
    """Convert text such as 1e-3 to a number; YAML 1.1 parses it as text because it has no dot."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
