"""Configurations in a log, read without opening or running files that they name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from diffdrive_mpc.models.checked_yaml import ConfigError, parse_yaml
from diffdrive_mpc.models.load import model_path
from diffdrive_mpc.models.trust import check_trusted, only_trusted
from diffdrive_mpc.mpc import ControllerConfig, load_config


def values_from_log(text: str, log: str | Path) -> Mapping[str, Any]:
    """Parse the `text` of a configuration in a `log`; raise ConfigError if it is not a YAML mapping."""
    try:
        values = parse_yaml(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{log}: configuration: not valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(values, Mapping):
        raise ConfigError(f"{log}: configuration: expected keys and values")
    return values


def config_from_log(values: Mapping[str, object], log: str | Path, trusted: Sequence[Path] = ()) -> ControllerConfig:
    """Return the configuration with the `values` that a log contains.

    Parameters
    ----------
    values
        Keys and values, as in the file of a configuration.
    log
        Name of the log, for messages.
    trusted
        Folders whose files the configuration may name.

    Raises
    ------
    models.trust.UntrustedFileError
        If it names a file of a model, term or feature that is neither shipped nor in a trusted folder.
    models.checked_yaml.ConfigError
        If the configuration is invalid, see `load_config`.
    """
    try:
        config = load_config(values)
    except ConfigError as error:
        raise ConfigError(f"{log}: {error}") from error
    with only_trusted(log, trusted):
        model_path(config.model)
        for group in config.features.values():
            group.check_files()
        for term in config.terms:
            check_trusted(term.file)
    return config
