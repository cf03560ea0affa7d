"""Load velocity models from parameter files, shipped or the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import ConfigError, check, read_yaml
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.named_file import named_file, shipped_names
from diffdrive_mpc.models.networks.network import NETWORK
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.structures.model_file import ModelFile, build_model
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel

DRIVES: Mapping[str, Literal["drive_experimental", "drive_physical"]] = {
    "p2_experimental": "drive_experimental",
    "p2_physical": "drive_physical",
}
"""Shipped drive models, and their structures."""
HYBRID = "hybrid"
"""Structure of a linear model with a network on what it leaves; none ships."""
_FUNCTIONS = (NETWORK, *DRIVES.values(), HYBRID)
PARAMETERS = Path(__file__).parent / "parameters"
MODEL_NAMES = (*(name for name in STRUCTURES if (PARAMETERS / f"{name}.yaml").is_file()), NETWORK, *DRIVES, "kinematic")
"""Shipped models: one of each structure that ships one, the network, the drives, the one to hold them against."""
ROBOTS = PARAMETERS / "robots"
ROBOT_NAMES = shipped_names(ROBOTS)
"""Real robots that were identified from public logs."""


def load_model(name: str | Path) -> VelocityModel | NonlinearModel:
    """Load a velocity model: a linear one, a network on past commands, a drive, or a hybrid.

    Parameters
    ----------
    name
        "mbm", "sm", "ssm", "lstm", "p2_experimental", "p2_physical", "kinematic", a robot of
        `ROBOT_NAMES`, or the path of a parameter file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such model or its file has a mistake.
    models.velocity_model.ModelError
        If the numbers cannot be a robot's: unstable, not finite, wrong units.
    models.errors.ArgumentError
        If it is neither a name nor a path.
    """
    if not isinstance(name, (str, Path)):
        raise wrong_type(
            "load_model",
            "a name such as 'ssm' or the path of a model file",
            name,
            "a system of python-control becomes a model with VelocityModel.from_control(system, dead_time=(0.0, 0.0))",
        )
    path = model_path(name)
    data = read_yaml(path)
    try:
        if _structure(data) in _FUNCTIONS:
            return _load_function(path, data)
        return build_model(_checked(path, data))
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from error


def _load_function(path: Path, data: Any) -> NonlinearModel:  # noqa: ANN401 - what a YAML file may hold
    """As the `load_...` of its kind; imported late: CasADi's graphs are not for who only loads a few matrices."""
    if data["structure"] == NETWORK:
        from diffdrive_mpc.models.networks.network_file import load_network  # noqa: PLC0415

        return load_network(path, data)
    if data["structure"] == HYBRID:
        from diffdrive_mpc.models.hybrids.hybrid_file import load_hybrid  # noqa: PLC0415

        return load_hybrid(path, data)
    from diffdrive_mpc.models.drives.drive_file import load_drive  # noqa: PLC0415

    return load_drive(path, data)


def load_linear_model(name: str | Path) -> VelocityModel:
    """Load a velocity model of matrices; raises ModelError where it is a function, else as `load_model`."""
    model = load_model(name)
    if not isinstance(model, VelocityModel):
        raise ModelError(f"model '{name}' is a function, here matrices are needed; name a linear model")
    return model


def load_base_effects(name: str | Path) -> BaseEffects:
    """Load what a model file says about the base around its model; raises ConfigError as `load_model`."""
    path = model_path(name)
    data = read_yaml(path)
    return BaseEffects() if _structure(data) in _FUNCTIONS else _checked(path, data).base_effects


def model_path(name: str | Path) -> Path:
    """The parameter file behind `name`; raises ConfigError when there is none."""
    if str(name) in ROBOT_NAMES:
        return ROBOTS / f"{name}.yaml"
    return named_file("model", PARAMETERS, name, MODEL_NAMES)


def read_model_file(path: str | Path) -> ModelFile:
    """Read and check the parameter file of a linear model without building the model."""
    return _checked(path, read_yaml(path))


def _structure(data: object) -> object:
    return data.get("structure") if isinstance(data, Mapping) else None


def _checked(path: str | Path, data: object) -> ModelFile:
    name = _structure(data)
    structure = STRUCTURES.get(name) if isinstance(name, str) else None
    if structure is None:
        known = ", ".join((*STRUCTURES, *_FUNCTIONS))
        raise ConfigError(f"{path}: structure: expected one of {known}, found {name!r}")
    return check(structure.file, data, str(path))
