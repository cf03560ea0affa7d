"""Loading of velocity models from shipped parameter files and from files of the user."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.checked_yaml import ConfigError, check, describe_kind, read_yaml
from diffdrive_mpc.models.errors import checked_call, wrong_type
from diffdrive_mpc.models.function_structure import FunctionStructure, function_structures
from diffdrive_mpc.models.named_file import named_file, shipped_names
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.plug_ins import check_package
from diffdrive_mpc.models.structures.model_file import ModelFile, build_model
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.suggestions import similar_name
from diffdrive_mpc.models.velocity_model import ModelError, VelocityModel

PARAMETERS = Path(__file__).parent / "parameters"
_PLAIN = "kinematic"
_LINEAR = {name: path for name in (*STRUCTURES, _PLAIN) if (path := PARAMETERS / f"{name}.yaml").is_file()}
ROBOTS = PARAMETERS / "robots"
ROBOT_NAMES = shipped_names(ROBOTS)
"""Names of real robots whose models were identified from public logs."""


@checked_call()
def load_model(name: str | Path) -> VelocityModel | NonlinearModel:
    """Load a velocity model: a linear model, a network on past commands, a drive model, or a hybrid.

    Parameters
    ----------
    name
        "mbm", "sm", "ssm", "two_delays", "lstm", "p2_experimental", "p2_physical", "kinematic", a robot of
        `ROBOT_NAMES`, or the path of a parameter file.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is no such model or its file is invalid.
    models.velocity_model.ModelError
        If the parameters cannot describe a robot: unstable, not finite, wrong units.
    models.errors.ArgumentError
        If `name` is neither a string nor a path.
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
        function = _function_structure(data)
        return build_model(_check_file(path, data)) if function is None else function.load(path, data)
    except ModelError as error:
        raise ModelError(f"{path.name}: {error}") from error


def model_names() -> tuple[str, ...]:
    """List the shipped models: one for each structure that ships a model, and the kinematic model for comparison."""
    return tuple(_shipped_files())


def is_shipped(name: str | Path) -> bool:
    """Return True if `name` is one of `model_names`."""
    return str(name) in _LINEAR or str(name) in _shipped_files()


def _shipped_files() -> dict[str, Path]:
    """Return the shipped parameter files by name; this loads plug-ins, which `_LINEAR` does not need."""
    functions = {structure.name: structure.shipped for structure in function_structures().values() if structure.shipped}
    linear = {name: path for name, path in _LINEAR.items() if name != _PLAIN}
    return linear | dict(sorted(functions.items())) | {_PLAIN: _LINEAR[_PLAIN]}


def load_linear_model(name: str | Path) -> VelocityModel:
    """Load a linear velocity model; raise ModelError if the model is nonlinear, and other errors as `load_model`."""
    model = load_model(name)
    if not isinstance(model, VelocityModel):
        raise ModelError(f"model '{name}' is nonlinear, but a linear model is required; name a linear model")
    return model


def load_base_effects(name: str | Path) -> BaseEffects:
    """Load the base effects from a model file; raise ConfigError as `load_model`."""
    path = model_path(name)
    data = read_yaml(path)
    return BaseEffects() if _function_structure(data) else _check_file(path, data).base_effects


def model_path(name: str | Path) -> Path:
    """Return the parameter file of a model name or path.

    Raise ConfigError if there is no such model, and MissingPackageError if its package is not installed.
    """
    if str(name) in ROBOT_NAMES:
        return ROBOTS / f"{name}.yaml"
    if str(name) in _LINEAR:
        return _LINEAR[str(name)]
    # Load plug-ins only if the name is not that of a linear model.
    shipped = _shipped_files()
    robots = {path.stem: path for kind in function_structures().values() for path in kind.robots}
    if path := (shipped | robots).get(str(name)):
        return path
    check_package("models", name)
    return named_file("model", PARAMETERS, name, tuple(shipped))


def read_model_file(path: str | Path) -> ModelFile:
    """Read and check the parameter file of a linear model without building the model."""
    return _check_file(path, read_yaml(path))


def _function_structure(data: object) -> FunctionStructure | None:
    """Return the structure of a nonlinear model's file; None for linear models, which need no plug-in."""
    name = _structure_name(data)
    return None if name in STRUCTURES else function_structures().get(name)


def _structure_name(data: object) -> str:
    """Return the name of the structure in the content of a file; empty if it is missing."""
    structure = data.get("structure") if isinstance(data, Mapping) else None
    return structure if isinstance(structure, str) else ""


def _check_file(path: str | Path, data: object) -> ModelFile:
    structure = STRUCTURES.get(_structure_name(data))
    if structure is None:
        check_package("structures", _structure_name(data))
        known = ", ".join((*STRUCTURES, *function_structures()))
        if isinstance(data, Mapping) and "structure" not in data and (kind := describe_kind(data)):
            raise ConfigError(f"{path}: this is {kind}")
        declared = data.get("structure") if isinstance(data, Mapping) else None
        hint = similar_name(str(declared), [*STRUCTURES, *function_structures()])
        raise ConfigError(f"{path}: structure: expected one of {known}, found {declared!r}{hint}")
    return check(structure.file, data, str(path))
