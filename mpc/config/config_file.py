"""Read a controller's configuration from its YAML file, and change single fields of it by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.named_file import is_file, named_file, shipped_names
from diffdrive_mpc.models.plug_ins import check_package
from diffdrive_mpc.models.two_sided import SIDES
from diffdrive_mpc.mpc.config.former_keys import with_present_names
from diffdrive_mpc.mpc.config.rooms import plain_key, shown_key, side_by_side
from diffdrive_mpc.mpc.config.schema import ControllerConfig

PARAMETERS = Path(__file__).parent / "parameters"


def load_config(
    source: str | Path | Mapping[str, object] | ControllerConfig = "ssm",
    overrides: Mapping[str, object] | None = None,
) -> ControllerConfig:
    """Read and check a configuration.

    Parameters
    ----------
    source
        "mbm", "sm" or "ssm" for the shipped configuration of that model, or the path of a YAML file. A relative path of
        a model, a term or a feature's file inside it is taken from the folder of the file. Or keys and values of such a
        file, for instance those that `identify` found. Or a configuration.
    overrides
        Values by dotted key, for instance ``{"horizon": 20, "weights.across": 200.0}``; those of the second room with
        or without ``expert.``.

    Raises
    ------
    models.checked_yaml.ConfigError
        With one line that names the file, the key, the mistake and the remedy.
    models.errors.ArgumentError
        If an argument is something else.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise wrong_type("overrides", "values by dotted key", overrides, "write {'weights.across': 200.0}")
    if isinstance(source, ControllerConfig):
        return replace_values(source, overrides) if overrides else source
    if isinstance(source, Mapping):
        return _checked(_replaced(side_by_side(source), overrides), "configuration")
    if not isinstance(source, (str, Path)):
        raise wrong_type(
            "configuration",
            "load_config(...), a name such as 'ssm', a path, or keys and values",
            source,
            "a model goes beside it: Controller('ssm', model=model)",
        )
    path = config_path(source)
    data = read_yaml(path)
    if not isinstance(data, Mapping):
        raise ConfigError(f"{path}: expected keys and values; an example: diffdrive-mpc config show ssm")
    where = path.stem if path.stem == str(source) else str(path)
    config = _checked(_replaced(side_by_side(data, where), overrides), where)
    beside = path.parent / config.model
    if not is_shipped(config.model) and not Path(config.model).is_absolute() and is_file(beside):
        config = config.model_copy(update={"model": str(beside)})
    features = {name: group.relative_to(path.parent) for name, group in config.features.items()}
    config = config.model_copy(update={"features": features})
    terms = [term.model_copy(update={"file": str((path.parent / term.file).absolute())}) for term in config.terms]
    return config.model_copy(update={"terms": terms}) if terms else config


def config_path(name: str | Path) -> Path:
    """Return the file of a configuration: one of this package, one of an installed package, or the user's own.

    Raises ConfigError if there is none, and MissingPackageError if a package that is not installed ships it.
    """
    ours = shipped_names(PARAMETERS)
    if str(name) in ours:
        return PARAMETERS / f"{name}.yaml"
    plugged = {structure.name: structure.config for structure in function_structures().values() if structure.config}
    if str(name) in plugged:
        return plugged[str(name)]
    check_package("models", name)
    return named_file("configuration", PARAMETERS, name, (*ours, *plugged))


def replace_values(config: ControllerConfig, overrides: Mapping[str, object]) -> ControllerConfig:
    """Return a validated copy of `config` with values replaced by dotted key; raise ConfigError."""
    return _checked(_replaced(config.model_dump(), overrides), "configuration")


def _checked(values: Mapping[str, object], where: str) -> ControllerConfig:
    return check(ControllerConfig, values, where, shown_key)


def _replaced(data: Mapping[str, Any], overrides: Mapping[str, object] | None) -> dict[str, Any]:
    replaced = dict(data)
    for key, value in (overrides or {}).items():
        replaced = _with_value(replaced, plain_key(key).split("."), value, key)
    return with_present_names(replaced)


def _with_value(data: Mapping[str, Any], keys: list[str], value: object, whole: str) -> dict[str, Any]:
    first, *rest = keys
    if not rest:
        # Numbers of NumPy, such as those of `np.arange`, as the schema knows them.
        return {**data, first: value.item() if isinstance(value, np.generic) else value}
    inner = data.get(first, {})
    if rest[0] in SIDES and isinstance(inner, (int, float)):
        inner = dict.fromkeys(SIDES[rest[0]], inner)
    if not isinstance(inner, Mapping):
        raise ConfigError(f"configuration: unknown key '{whole}': '{first}' holds one value, not a group")
    return {**data, first: _with_value(inner, rest, value, whole)}
