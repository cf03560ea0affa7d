"""An identified model as a parameter file that `load_model` takes."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.identification.identified import IdentifiedModel, rounded
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.structures import ModelFile
from diffdrive_mpc.models.velocity_model import CHANNELS

_HEAD = (
    "# Identified from a log. Gains and damping [-], frequencies and poles [rad/s], times [s], lengths [m], "
    "twists [m/s, rad/s].\n"
)
_PERCENT_DIGITS = 2
_CORRELATION_DIGITS = 4


def model_file(
    identified: IdentifiedModel,
    *,
    name: str,
    source: str,
    records: Sequence[str],
    date: datetime.date,
    train_fit_percent: FloatArray,
    validation_fit_percent: FloatArray | None = None,
    notes: str = "",
) -> ModelFile:
    """The checked content of a parameter file, with provenance and uncertainty.

    Parameters
    ----------
    identified
        What was identified.
    name
        Name of the model for tables and messages.
    source
        The log, and the robot where that is known.
    records
        Which stretches of it the model was identified from.
    date
        Day of the identification.
    train_fit_percent, validation_fit_percent
        (2,) simulation FIT of v and omega [%] on those records, and on others.
    notes
        Anything a reader should know.

    Raises
    ------
    pydantic.ValidationError
        If a number is not finite.
    """
    provenance = {
        "origin": "identified",
        "source": source,
        "method": f"{identified.method}; omega of the {identified.yaw}",
        "experiments": list(records),
        "date": date.isoformat(),
        "notes": notes,
    }
    more: dict[str, Any] = {
        "fit_percent": _percent(train_fit_percent),
        "uncertainty": uncertainty(identified.parameters),
        "warnings": list(identified.warnings),
    }
    if validation_fit_percent is not None:
        more["validation_fit_percent"] = _percent(validation_fit_percent)
    if identified.limits:
        more["limits"] = dict(identified.limits)
    return identified.file(name, provenance, **more)


def write_model_file(path: Path, content: ModelFile) -> None:
    """Write a parameter file; raises OSError if it cannot be written."""
    data = content.model_dump(exclude_none=True, exclude_defaults=True)
    first = ("name", "structure", "provenance", "fit_percent", "validation_fit_percent", "limits", "warnings")
    ordered = {key: data[key] for key in first if key in data}
    ordered |= {key: value for key, value in data.items() if key not in (*first, "uncertainty")}
    ordered |= {key: data[key] for key in ("uncertainty",) if key in data}
    text = yaml.safe_dump(ordered, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
    path.write_text(_HEAD + text, encoding="utf-8")


def uncertainty(estimate: Estimate) -> Mapping[str, Any]:
    """What the parameter file says about how well parameters are known."""
    deviation = estimate.standard_deviation
    scale = np.where(deviation > 0, deviation, 1.0)
    correlation = np.clip(estimate.covariance / np.outer(scale, scale), -1.0, 1.0)
    return {
        "parameters": list(estimate.names),
        "value": rounded(estimate.values),
        "standard_deviation": [float(f"{value:.4g}") for value in deviation],
        "correlation": [[round(float(value), _CORRELATION_DIGITS) for value in row] for row in correlation],
    }


def _percent(fit: FloatArray) -> dict[str, float]:
    return {channel: round(float(value), _PERCENT_DIGITS) for channel, value in zip(CHANNELS, fit, strict=True)}
