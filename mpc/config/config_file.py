"""Loading of a controller's configuration from a file, and replacement of single values by key."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.errors import UnusualValueWarning, checked_call, wrong_type
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.named_file import is_file, looks_like_path, named_file, shipped_names
from diffdrive_mpc.models.plug_ins import check_package
from diffdrive_mpc.models.two_sided import SIDES
from diffdrive_mpc.mpc.config.former_keys import convert_former_keys
from diffdrive_mpc.mpc.config.rooms import merge_sections, plain_key, shown_key
from diffdrive_mpc.mpc.config.schema import ControllerConfig

PARAMETERS = Path(__file__).parent / "parameters"
"""Folder of the built-in configurations."""
_MAX_PLAUSIBLE_OMEGA = 15.0
"""Yaw rate limit above which the value is probably in degrees per second [rad/s]."""


@checked_call()
def load_config(
    source: str | Path | Mapping[str, object] | ControllerConfig = "ssm",
    overrides: Mapping[str, object] | None = None,
    **keywords: object,
) -> ControllerConfig:
    """Read and check a configuration.

    Parameters
    ----------
    source
        Name of a built-in configuration such as "mbm", "sm" or "ssm"; path of a YAML file; keys and values of such a
        file, for instance from `identify`; or a configuration. Relative paths in a file (of a model, a term or a file
        of a feature) are relative to the folder of that file.
    overrides
        Values by dotted key, for instance ``{"horizon": 20, "weights.across": 200.0}``; the prefix ``expert.`` is
        optional.
    keywords
        Further overrides, for instance ``horizon=20`` or ``weights={"across": 200.0}``.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the configuration is invalid; the message is one line with the file, the key, the mistake and the remedy.
    models.errors.ArgumentError
        If an argument has a wrong type.
    """
    if overrides is not None and not isinstance(overrides, Mapping):
        raise wrong_type("overrides", "values by dotted key", overrides, "write {'weights.across': 200.0}")
    overrides = {**(overrides or {}), **keywords}
    if isinstance(source, ControllerConfig):
        return replace_values(source, overrides) if overrides else source
    if isinstance(source, Mapping):
        return _check_config(_apply_overrides(merge_sections(source), overrides), "configuration")
    if not isinstance(source, (str, Path)):
        remedy = "pass a model as a separate argument, as in Controller('ssm', model=model)"
        if isinstance(getattr(source, "config", None), ControllerConfig):
            remedy = "give the configuration of the controller: controller.config"
        kinds = "load_config(...), a name such as 'ssm', a path, or keys and values"
        raise wrong_type("configuration", kinds, source, remedy)
    path = config_path(source)
    data = read_yaml(path)
    if not isinstance(data, Mapping):
        raise ConfigError(f"{path}: expected keys and values; an example: diffdrive-mpc config show ssm")
    where = path.stem if path.stem == str(source) else str(path)
    config = _check_config(_apply_overrides(merge_sections(data, where), overrides), where)
    # The working directory may have another robot's model of the same name, so it is not searched.
    if "model" not in overrides and looks_like_path(config.model):
        config = config.model_copy(update={"model": str(path.parent / config.model)})
    features = {name: group.relative_to(path.parent) for name, group in config.features.items()}
    config = config.model_copy(update={"features": features})
    terms = [term.model_copy(update={"file": str((path.parent / term.file).absolute())}) for term in config.terms]
    return config.model_copy(update={"terms": terms}) if terms else config


def model_of(config: ControllerConfig) -> str:
    """Return the name or path of the model; raise ConfigError if there is no file at the path."""
    if looks_like_path(config.model) and not is_file(config.model):
        raise ConfigError(
            f"key 'model' of the configuration: there is no file '{config.model}'; copy the model there, or give it as "
            "--model FILE, in Python as model=result.model"
        )
    return config.model


def config_path(name: str | Path) -> Path:
    """Return the path of a configuration file of this package, of an installed package, or of the user.

    Raises ConfigError if the file does not exist, and MissingPackageError if it belongs to a package that is not
    installed.
    """
    shipped = shipped_names(PARAMETERS)
    if str(name) in shipped:
        return PARAMETERS / f"{name}.yaml"
    packaged = {structure.name: structure.config for structure in function_structures().values() if structure.config}
    if str(name) in packaged:
        return packaged[str(name)]
    check_package("models", name)
    if not is_file(name):
        from diffdrive_mpc.models.stated_robot import STATED_ROBOTS  # noqa: PLC0415 - only for unknown names

        if str(name) in STATED_ROBOTS.names:
            remedy = f"data of the robot, for a first one: diffdrive-mpc config show kinematic --robot {name}"
            raise ConfigError(f"unknown configuration '{name}': {remedy}")
    return named_file("configuration", PARAMETERS, name, (*shipped, *packaged))


def replace_values(config: ControllerConfig, overrides: Mapping[str, object]) -> ControllerConfig:
    """Return a validated copy of `config` with values replaced by dotted key; raise ConfigError for invalid values."""
    return _check_config(_apply_overrides(config.model_dump(), overrides), "configuration")


def _check_config(values: Mapping[str, object], where: str) -> ControllerConfig:
    config = check(ControllerConfig, values, where, shown_key)
    fastest = max(config.limits.omega.sides)
    if fastest > _MAX_PLAUSIBLE_OMEGA:
        degrees = f"if it is in degrees, give {np.radians(fastest):.3g}"
        message = f"{where}: limits.omega = {fastest:g} rad/s is {fastest / (2 * np.pi):.1f} turns a second; {degrees}"
        warnings.warn(message, UnusualValueWarning, stacklevel=4)
    return config


def _apply_overrides(data: Mapping[str, Any], overrides: Mapping[str, object]) -> dict[str, Any]:
    result = dict(data)
    for key, value in overrides.items():
        result = _with_value(result, plain_key(str(key)).split("."), value, str(key))
    return convert_former_keys(result)


def _with_value(data: Mapping[str, Any], keys: list[str], value: object, dotted_key: str) -> dict[str, Any]:
    """Return `data` with the value at the nested `keys` replaced; `dotted_key` is the name of the key in messages."""
    first, *inner_keys = keys
    if not inner_keys:
        # NumPy numbers, such as those of `np.arange`, are converted to Python numbers for the schema.
        return {**data, first: value.item() if isinstance(value, np.generic) else value}
    inner = data.get(first, {})
    # The key is a side of a limit that is given as one number for both sides.
    if inner_keys[0] in SIDES and isinstance(inner, (int, float)):
        inner = dict.fromkeys(SIDES[inner_keys[0]], inner)
    if not isinstance(inner, Mapping):
        raise ConfigError(f"configuration: unknown key '{dotted_key}': '{first}' holds one value, not a group")
    return {**data, first: _with_value(inner, inner_keys, value, dotted_key)}
