"""Read `KEY=VALUE` and `KEY=V1,V2,...` as they are typed on the command line."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import yaml

from diffdrive_mpc.bench.case import Overrides, check_count
from diffdrive_mpc.models.bounded_yaml import parse_yaml
from diffdrive_mpc.models.checked_yaml import ConfigError


def parse_setting(text: str) -> tuple[str, list[object]]:
    """Split `KEY=V1,V2,...` into the dotted key and its values.

    Raises ConfigError if there is no key, no value, or the values are no YAML.
    """
    key, equals, listed = text.partition("=")
    if not equals or not key.strip() or not listed.strip():
        raise ConfigError(f"--set {text}: write KEY=VALUE or KEY=V1,V2,..., for instance weights.across=100,200")
    try:
        values = parse_yaml(f"[{listed}]")
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {text}: '{listed}' cannot be read as values separated by commas") from error
    if not values or any(isinstance(value, (list, dict)) for value in values):
        raise ConfigError(f"--set {text}: each value must be a number, a word, true or false; groups have dotted keys")
    if key.strip() == "model":
        raise ConfigError(f"--set {text}: models are chosen with --model (simulate) or --models (bench)")
    return key.strip(), [_number(value) for value in values]


def single_settings(texts: Sequence[str]) -> Overrides:
    """Settings with one value each, as `simulate` takes them; raises ConfigError as `sweep_settings` does."""
    combinations = sweep_settings(texts)
    if len(combinations) > 1:
        raise ConfigError("--set: one value for each key here; to compare several values use 'bench'")
    return combinations[0]


def sweep_settings(texts: Sequence[str]) -> list[Overrides]:
    """Every combination of the values of several settings, in the order given; one empty combination without any.

    Raises ConfigError as for `parse_setting`, and if a key or a value is given twice.
    """
    parsed = [parse_setting(text) for text in texts]
    keys = [key for key, _ in parsed]
    for key, values in parsed:
        if keys.count(key) > 1:
            raise ConfigError(f"--set {key}: given twice; list its values in one: {key}=V1,V2")
        if len(set(values)) < len(values):
            raise ConfigError(f"--set {key}: a value is listed twice")
    check_count(math.prod(len(values) for _, values in parsed))
    return [tuple(zip(keys, combination, strict=True)) for combination in itertools.product(*(v for _, v in parsed))]


def _number(value: object) -> object:
    """YAML 1.1 reads 1e-3, without a dot, as text."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value
