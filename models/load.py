"""Load velocity models from parameter files, shipped or the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.named_file import named_file, shipped_names
from diffdrive_mpc.models.structures.model_file import ModelFile, build_model
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel

PARAMETERS = Path(__file__).parent / "parameters"
MODEL_NAMES = (*(name for name in STRUCTURES if (PARAMETERS / f"{name}.yaml").is_file()), "kinematic")
"""Shipped models: one of each structure that ships one, and the one to hold them against."""
ROBOTS = PARAMETERS / "robots"
ROBOT_NAMES = shipped_names(ROBOTS)
"""Real robots that were identified from public logs."""


def load_model(name: str | Path) -> VelocityModel:
    """Load a velocity model.

    Parameters
    ----------
    name
        "mbm", "sm", "ssm", "kinematic", a robot of `ROBOT_NAMES`, or the path of a parameter file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such model or its file has a mistake.
    models.velocity_model.ModelError
        If the numbers cannot be a robot's: unstable, not finite, wrong units.
    """
    path = model_path(name)
    try:
        return build_model(read_model_file(path))
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from error


def load_base_effects(name: str | Path) -> BaseEffects:
    """Load what a model file says about the base around its linear model; raises ConfigError as `load_model`."""
    return read_model_file(model_path(name)).base_effects


def model_path(name: str | Path) -> Path:
    """The parameter file behind `name`; raises ConfigError when there is none."""
    if str(name) in ROBOT_NAMES:
        return ROBOTS / f"{name}.yaml"
    return named_file("model", PARAMETERS, name, MODEL_NAMES)


def read_model_file(path: str | Path) -> ModelFile:
    """Read and check a model parameter file without building the model."""
    data: Any = read_yaml(path)
    name = data.get("structure") if isinstance(data, Mapping) else None
    structure = STRUCTURES.get(name) if isinstance(name, str) else None
    if structure is None:
        raise ConfigError(f"{path}: structure: expected one of {', '.join(STRUCTURES)}, found {name!r}")
    return check(structure.file, data, str(path))
