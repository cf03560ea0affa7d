"""Folder of an exported controller: sources of the core, generated C, examples and build files."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from diffdrive_mpc import Term, core_sources
from diffdrive_mpc.core_sources import SIZES, all_terms, build_problem, chosen_model, core_texts, generated_functions
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.config.solver import Solver
from diffdrive_mpc.mpc.features.registry import feature_terms, prepare_config
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds
from diffdrive_mpc_extras.export.generated_c import constants_text, operations_bound, sizes_text, trajectory_texts
from diffdrive_mpc_extras.free_space.config import free_space_of

core_sources.require(1)

_SOURCES = Path(__file__).parent / "sources"

FOLDERS, FILES = ("ddmpc", "examples", "stm32f4"), ("CMakeLists.txt",)
"""Names of the folders and files of an export."""


class Precision(StrEnum):
    """Floating-point type of the exported controller."""

    DOUBLE = "double"
    FLOAT = "float"


@dataclass(frozen=True)
class ExportedLibrary:
    """Description of an exported controller.

    Attributes
    ----------
    model
        Name of the velocity model.
    states
        Order of the model.
    terms
        Names of the user-defined cost terms and constraints.
    operations_bound
        Maximum number of active-set operations per tick; see `SolverReport.operations`.
    """

    model: str
    states: int
    terms: tuple[str, ...]
    operations_bound: int


def export_controller(
    config: ControllerConfig,
    reference: Reference,
    folder: Path,
    precision: Precision = Precision.DOUBLE,
    *,
    model: VelocityModel | NonlinearModel | str | None = None,
    terms: Sequence[Term] = (),
) -> ExportedLibrary:
    """Write the controller of `config` as a C99 library into `folder`, with `reference` in closed form.

    The sources are those of the Python controller; sizes become macros, and parameters become constants.

    Parameters
    ----------
    config, model, terms
        Arguments of `Controller`; weights and limits become constants. Re-entry and backends are not exported.
    reference
        Trajectory for the table and the examples; an application may track other trajectories.
    folder
        Existing folder; files of the same names are replaced.
    precision
        Floating-point type; times are always double.

    Raises
    ------
    models.checked_yaml.ConfigError, models.velocity_model.ModelError, ValueError
        If the controller cannot be built, the reference exceeds the limits, or the configuration requires a backend or
        free space.
    """
    _check(config.solver)
    if free_space_of(config).is_enabled:
        raise ConfigError(
            "expert.free_space.enabled: an exported controller does not support obstacle avoidance; set it to false, "
            "and avoid collisions by other means"
        )
    velocity_model = chosen_model(config, model)
    config = prepare_config(config)
    terms = all_terms(config.terms, (*terms, *feature_terms(config)))
    # An exported controller has no re-entry: away from the path, it follows the reference directly or brakes.
    config = config.model_copy(update={"reentry": config.reentry.model_copy(update={"enabled": False})})
    problem = build_problem(config, velocity_model, terms)
    check_speeds(reference, config.limits, config.sample_time)
    functions = generated_functions(velocity_model, terms)
    texts = {
        **core_texts(),
        SIZES: sizes_text(problem, is_single=precision is Precision.FLOAT),
        "constants.c": constants_text(problem, functions.stem if functions else None),
        **trajectory_texts(reference, config.sample_time),
    }
    if functions:
        texts |= {f"{functions.stem}.c": functions.source, f"{functions.stem}.h": functions.header}
    shutil.copytree(_SOURCES / "project", folder, dirs_exist_ok=True)
    source_folder = folder / "ddmpc"
    shutil.copytree(_SOURCES / "controller", source_folder, dirs_exist_ok=True)
    for name, text in texts.items():
        (source_folder / name).write_text(text, encoding="utf-8")
    names = tuple(term.name for term in terms)
    return ExportedLibrary(velocity_model.name, problem.model.order, names, operations_bound(problem))


def _check(solver: Solver) -> None:
    if solver.method != "auto" or solver.active_set_iterations == 0:
        raise ConfigError(
            f"solver.method = {solver.method}, solver.active_set_iterations = {solver.active_set_iterations}: an "
            "exported controller has neither OSQP nor DAQP; set solver.method to auto and active_set_iterations above 0"
        )
