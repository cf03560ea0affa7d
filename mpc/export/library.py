"""Write the folder of an exported controller."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.export.constants import constants_text, sizes_text
from diffdrive_mpc.mpc.export.osqp_workspaces import QpShape, write_osqp
from diffdrive_mpc.mpc.export.parts import build_parts
from diffdrive_mpc.mpc.export.reference_table import table_text
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds

_NATIVE = Path(__file__).parents[1] / "native"
# Of the sources that Python compiles for itself, those that a controller needs.
_SHARED = ("real", "arc", "tile", "checks", "filter", "estimator", "condense", "relax")
_SOURCES = Path(__file__).parent / "sources"
# Closer than this, the residuals of single precision do not come to zero.
_FINEST_FLOAT_TOLERANCE = 1e-6


FOLDERS, FILES = ("ddmpc", "osqp", "examples", "stm32f4"), ("CMakeLists.txt",)
"""Names of what is written."""


class Precision(StrEnum):
    """Number type of the exported controller."""

    DOUBLE = "double"
    FLOAT = "float"


@dataclass(frozen=True)
class ExportedLibrary:
    """What was written.

    Attributes
    ----------
    osqp
        Version of the solver.
    slots
        Soft limits that may matter at one tick.
    states
        Of the velocity model.
    """

    osqp: str
    slots: int
    states: int


def export_controller(
    config: ControllerConfig,
    reference: Reference,
    folder: Path,
    precision: Precision = Precision.DOUBLE,
    slots: int | None = None,
) -> ExportedLibrary:
    """Write the controller of `config` as a C99 library into `folder`, with `reference` as a table.

    Parameters
    ----------
    config
        Configuration; its model, weights and limits become constants.
    reference
        Trajectory for the table and the examples; the application may track any other.
    folder
        An existing folder; files of the same names are replaced.
    precision
        Number type; instants are double in both.
    slots
        Soft limits that may matter at one tick, 1 to 5 N; N by default.

    Raises
    ------
    models.checked_yaml.ConfigError, models.velocity_model.ModelError, ValueError
        If the controller cannot be built, the reference is too fast for its limits, the tolerance is finer than the
        precision allows, or the number of slots is impossible.
    """
    single = precision is Precision.FLOAT
    if single and config.solver.tolerance < _FINEST_FLOAT_TOLERANCE:
        raise ConfigError(
            f"solver.tolerance = {config.solver.tolerance:g}: single precision does not reach it; set it to "
            f"{_FINEST_FLOAT_TOLERANCE:g} or more, or export in double precision"
        )
    if config.solver.formulation != "condensed" or config.solver.backend != "osqp":
        raise ConfigError(
            f"solver.formulation = {config.solver.formulation}, solver.backend = {config.solver.backend}: only the "
            "condensed formulation with osqp can be exported; set them so"
        )
    slots = config.horizon if slots is None else slots
    if not 1 <= slots <= 5 * config.horizon:
        raise ConfigError(f"--soft-slots {slots}: give 1 to {5 * config.horizon}, five for each step of the horizon")
    parts = build_parts(config)
    check_speeds(reference, config.limits, config.sample_time)
    hessian, soft_rows = parts.typical_program()
    shape = QpShape(hessian, soft_rows, slots)
    shutil.copytree(_SOURCES / "project", folder, dirs_exist_ok=True)
    ours = folder / "ddmpc"
    shutil.copytree(_SOURCES / "controller", ours, dirs_exist_ok=True)
    for name in _SHARED:
        for source in _NATIVE.glob(f"{name}.[ch]"):
            shutil.copyfile(source, ours / source.name)
    table, table_header = table_text(reference, config.sample_time)
    texts = {
        "ddmpc_sizes.h": sizes_text(parts, slots, single=single),
        "constants.c": constants_text(parts, shape, single=single),
        "trajectory.c": table,
        "trajectory.h": table_header,
    }
    for name, text in texts.items():
        (ours / name).write_text(text, encoding="utf-8")
    solver = write_osqp(folder / "osqp", shape, config, single=single)
    return ExportedLibrary(solver, slots, parts.sampled.order)
