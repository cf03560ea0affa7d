"""Velocity models as text for the terminal."""

from __future__ import annotations

import textwrap

import numpy as np

from diffdrive_mpc.bench.progress import output_console
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import load_model, model_names
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel

_LABEL = 19
"""Width of the column of labels, including the space between the columns [characters]."""


def print_models() -> None:
    """Print one row for each built-in model."""
    rows = []
    for name in model_names():
        model = load_model(name)
        gains = [f"{model.dc_gain[i, i]:.3f}" for i in (0, 1)]
        lags = [f"{1e3 * lag:.0f}" for lag in model.lag]
        rows.append((name, str(model.provenance.get("origin", "")), str(model.order), *gains, *lags))
    columns = ("model", "origin", "states", "gain v [-]", "gain omega [-]", "lag v [ms]", "lag omega [ms]")
    note = "Gains at rest. Lag: mean delay of the output, with dead time. Details: diffdrive-mpc models show NAME"
    output_console().print(Table("Velocity models", columns, tuple(rows), text_columns=2, note=note).rich())


def print_model(name: str) -> None:
    """Print all properties of a model; raise ConfigError or ModelError if the model cannot be loaded."""
    console = output_console()
    for line in model_text(load_model(name), console.width).splitlines():
        for part in _wrap(line, console.width):
            console.print(part, markup=False, highlight=False, soft_wrap=True)


def model_text(model: VelocityModel | NonlinearModel, width: int = 140) -> str:
    """Format matrices or architecture, poles, gains and provenance as text; matrices are at most `width` wide."""
    lines = _function_lines(model) if isinstance(model, NonlinearModel) else _linear_lines(model, width)
    return "\n".join([*lines, *(f"{key:<18} {_text(value)}" for key, value in model.provenance.items() if value)])


def _wrap(line: str, width: int) -> list[str]:
    """Wrap a line between words and indent continuation lines to the column of values."""
    return textwrap.wrap(line, width, subsequent_indent=" " * _LABEL, break_long_words=False, break_on_hyphens=False)


def _linear_lines(model: VelocityModel, width: int) -> list[str]:
    poles = sorted(model.poles, key=lambda pole: (-pole.real, pole.imag))
    lines = [
        f"{model.name} ({model.structure.upper()}, {model.order} states)",
        f"dead time [s]      v {model.dead_time[0]:.4g}, omega {model.dead_time[1]:.4g}",
        f"lag [s]            v {model.lag[0]:.4g}, omega {model.lag[1]:.4g}",
        f"poles [rad/s]      {', '.join(_pole(pole) for pole in poles)}",
    ]
    for label, matrix in (("dc gain", model.dc_gain), ("A", model.A), ("B", model.B), ("C", model.C)):
        lines += _matrix_lines(label, matrix, width)
    return lines


def _function_lines(model: NonlinearModel) -> list[str]:
    lines = [
        f"{model.name} ({model.structure.upper()}, {model.order} states)",
        f"sample time [s]    {model.dt:.4g}",
        f"past commands      {model.memory}",
        f"lag at rest [s]    v {model.lag[0]:.4g}, omega {model.lag[1]:.4g}",
        *_matrix_lines("dc gain at rest", model.dc_gain, width=140),
    ]
    return [*lines, *(f"{label:<18} {words}" for label, words in model.details)]


def _matrix_lines(label: str, matrix: FloatArray, width: int) -> list[str]:
    rows = np.array2string(matrix, precision=5, suppress_small=True, max_line_width=width - _LABEL).splitlines()
    return [f"{label if i == 0 else '':<18} {row}" for i, row in enumerate(rows)]


def _pole(pole: complex) -> str:
    return f"{pole.real:.4g}" if abs(pole.imag) < 1e-9 else f"{pole.real:.4g}{pole.imag:+.4g}j"


def _text(value: object) -> str:
    return "; ".join(map(str, value)) if isinstance(value, (list, tuple)) else " ".join(str(value).split())
