"""Read a controller's configuration from its YAML file, and change single fields of it by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.load import MODEL_NAMES
from diffdrive_mpc.models.named_file import named_file
from diffdrive_mpc.mpc.config.schema import ControllerConfig

PARAMETERS = Path(__file__).parent / "parameters"


def load_config(
    source: str | Path | Mapping[str, object] = "ssm", overrides: Mapping[str, object] | None = None
) -> ControllerConfig:
    """Read and check a configuration.

    Parameters
    ----------
    source
        "mbm", "sm" or "ssm" for the shipped configuration of that model, or the path of a YAML file. A relative
        path of a model, a term or turn costs inside that file is taken from the folder of the file. Or keys and values
        as such a file holds them, for instance those that `identify` found.
    overrides
        Values by dotted key, for instance ``{"horizon": 20, "weights.across": 200.0}``.

    Raises
    ------
    models.checked_yaml.ConfigError
        With one line that names the file, the key, the mistake and the remedy.
    """
    if isinstance(source, Mapping):
        return check(ControllerConfig, _replaced(source, overrides), "configuration")
    path = named_file("configuration", PARAMETERS, source)
    data = read_yaml(path)
    if not isinstance(data, Mapping):
        raise ConfigError(f"{path}: expected keys and values; an example: diffdrive-mpc config show ssm")
    shipped = path.parent == PARAMETERS
    config = check(ControllerConfig, _replaced(data, overrides), path.stem if shipped else str(path))
    beside = path.parent / config.model
    if config.model not in MODEL_NAMES and not Path(config.model).is_absolute() and beside.is_file():
        config = config.model_copy(update={"model": str(beside)})
    beside = path.parent / config.energy.turn_costs
    if config.energy.turn_costs and not Path(config.energy.turn_costs).is_absolute() and beside.is_file():
        energy = config.energy.model_copy(update={"turn_costs": str(beside)})
        config = config.model_copy(update={"energy": energy})
    terms = [term.model_copy(update={"file": str((path.parent / term.file).absolute())}) for term in config.terms]
    return config.model_copy(update={"terms": terms}) if terms else config


def replace_values(config: ControllerConfig, overrides: Mapping[str, object]) -> ControllerConfig:
    """A copy of `config` with values replaced by dotted key, checked anew; raises ConfigError."""
    return check(ControllerConfig, _replaced(config.model_dump(), overrides), "configuration")


def _replaced(data: Mapping[str, Any], overrides: Mapping[str, object] | None) -> dict[str, Any]:
    replaced = dict(data)
    for key, value in (overrides or {}).items():
        replaced = _with_value(replaced, key.split("."), value, key)
    return replaced


def _with_value(data: Mapping[str, Any], keys: list[str], value: object, whole: str) -> dict[str, Any]:
    first, *rest = keys
    if not rest:
        return {**data, first: value}
    inner = data.get(first, {})
    if not isinstance(inner, Mapping):
        raise ConfigError(f"configuration: unknown key '{whole}': '{first}' holds one value, not a group")
    return {**data, first: _with_value(inner, rest, value, whole)}
