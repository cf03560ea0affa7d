"""Result of an identification of any structure, and its conversion to a parameter file."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects, TwistRange
from diffdrive_mpc.models.doubt import Doubt, lines
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import YawSource
from diffdrive_mpc.models.output_error.input_limits import limits_in
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.solve import OutputErrorFit
from diffdrive_mpc.models.output_error.state_space import LinearSystem
from diffdrive_mpc.models.structures.channel import pole_estimate
from diffdrive_mpc.models.structures.model_file import (
    ModelFile,
    TransferFunction,
    build_model,
    structure_name,
    write_parameters,
)
from diffdrive_mpc.models.two_sided import TwoSided
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel, mean_delay

# Significant digits in the file, much finer than any standard deviation.
_DIGITS = 8
_HEAD = (
    "Identified from a log. Gains and damping [-], frequencies and poles [rad/s], times [s], lengths [m], "
    "twists [m/s, rad/s]."
)
_PERCENT_DIGITS = 2
_CORRELATION_DIGITS = 4
# Provenance for a file content that is not stored.
_PROVENANCE = {"origin": "identified", "source": ""}


def _delay_names(groups: Sequence[str]) -> list[str]:
    return [f"{group}.{part}" for group in groups for part in ("sum", "dead_time", "lag")]


def _fields(group: str, file: type[TransferFunction]) -> list[str]:
    return [f"{group}.{name}" for name in file.model_fields]


@dataclass(frozen=True)
class IdentifiedModel:
    """An identified velocity model.

    Attributes
    ----------
    schema
        Schema of the structure's parameter file.
    content
        Keys and values of the parameter file for the dynamics, rounded as in the file.
    parameters
        Estimated parameters, with covariance; SI units.
    offset
        (2,) sensor bias of v [m/s] and omega [rad/s]; readings are the model's outputs plus this bias.
    yaw
        Sensor of omega.
    method
        Description of the identification method.
    fits
        Fits from which the model is derived: one for each channel, or one for both channels.
    warnings
        Doubts about the result.
    """

    schema: type[ModelFile]
    content: Mapping[str, Any]
    parameters: ParameterEstimate
    offset: FloatArray
    yaw: YawSource
    method: str
    fits: tuple[OutputErrorFit, ...]
    warnings: tuple[Doubt, ...]

    @property
    def delays(self) -> ParameterEstimate | None:
        """Total delay, dead time and lag [s] of each channel or motor, with covariance.

        Their names are `v.sum`, `v.dead_time`, `v.lag` and so on. None for a structure without transfer functions and
        without a common fit of both channels.
        """
        groups = self._transfer_functions

        def group_delays(row: FloatArray) -> FloatArray:
            value = dict(zip(self.parameters.names, row, strict=True))
            dead_time = [value.get(f"{group}.dead_time", value.get("v.dead_time", 0.0)) for group in groups]
            lag = [file.lag([value[name] for name in _fields(group, file)]) for group, file in groups.items()]
            return np.column_stack([np.add(dead_time, lag), dead_time, lag]).ravel()

        if groups:
            return self.parameters.derived(_delay_names(list(groups)), group_delays)
        if len(self.fits) != 1:
            return None
        fit = self.fits[0]

        def system_delays(row: FloatArray) -> FloatArray:
            system = fit.layout.system(row)
            total = mean_delay(system.A, system.B, system.C, system.dead_time, range(len(CHANNELS)))
            return np.column_stack([total, system.dead_time, total - system.dead_time]).ravel()

        return fit.derived(_delay_names(CHANNELS), system_delays)

    @property
    def poles(self) -> list[ParameterEstimate]:
        """Poles [rad/s] of each channel or motor, or of the whole model, named by `pole_names`."""
        groups = self._transfer_functions
        if groups:
            return [pole_estimate(self.parameters.part(_fields(*group)), group[1]) for group in groups.items()]
        return [self.parameters.part([name for name in self.parameters.names if name.startswith("pole_")])]

    @property
    def _transfer_functions(self) -> dict[str, type[TransferFunction]]:
        """Schemas of the transfer functions whose coefficients are all estimated, by prefix of the parameters."""
        groups = self.file("identified", _PROVENANCE).transfer_functions()
        files = {group: type(part) for group, part in groups.items()}
        return {group: file for group, file in files.items() if set(_fields(group, file)) <= {*self.parameters.names}}

    @property
    def base_effects(self) -> BaseEffects:
        """Effects of the base in addition to the linear model."""
        return BaseEffects.model_validate(self.content.get("base_effects", {}))

    @property
    def limits(self) -> dict[str, TwoSided]:
        """Limits of the command inside the base, by channel; channels without an identified limit are absent."""
        group = self.base_effects.twist_range or TwistRange()
        return {channel: limit for channel in CHANNELS if (limit := getattr(group, channel)) is not None}

    @property
    def structure(self) -> str:
        """Name of the structure: "mbm", "sm", "ssm", "two_delays" or "mbm_modes"."""
        return structure_name(self.schema)

    @property
    def model(self) -> VelocityModel:
        """The velocity model; raises ModelError if its parameters cannot describe a robot."""
        return build_model(self.file("identified", _PROVENANCE | {"source": self.method}))

    @property
    def system(self) -> LinearSystem:
        """Linear system with sensor offsets and limits of the base, for comparison with a log."""
        data = self.file("identified", _PROVENANCE)
        dead_time = np.array([data.dead_time.v, data.dead_time.omega])
        return LinearSystem(*data.matrices(), dead_time, self.offset, limits_in(data.base_effects))

    def file(self, name: str, provenance: Mapping[str, Any], **more: object) -> ModelFile:
        """Build the content of a parameter file; `more` contains additional keys."""
        return self.schema.model_validate(
            {"name": name, "structure": self.structure, "provenance": provenance, **self.content, **more}
        )


def round_values(value: object) -> Any:  # noqa: ANN401 - nested numbers for YAML
    """Round numbers, and nested arrays or mappings of numbers, to the digits of a file; return Python floats."""
    if isinstance(value, Mapping):
        return {key: round_values(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [round_values(entry) for entry in value]
    return float(f"{float(value):.{_DIGITS}g}")  # type: ignore[arg-type]


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
    """Build and check the content of a parameter file, with provenance and uncertainty.

    Parameters
    ----------
    identified
        The identified model.
    name
        Name of the model for tables and messages.
    source
        The log and, if known, the robot.
    records
        Names of the training records.
    date
        Date of the identification.
    train_fit_percent, validation_fit_percent
        (2,) simulation FIT of v and omega [%] on training and validation records.
    notes
        Additional information.

    Raises
    ------
    pydantic.ValidationError
        If a value is not finite.
    """
    method = f"{identified.method}; omega of the {identified.yaw}"
    origin = provenance(method, source=source, records=records, date=date, notes=notes)
    more: dict[str, Any] = {
        "fit_percent": percent(train_fit_percent),
        "uncertainty": uncertainty(identified.parameters),
        "warnings": list(lines(identified.warnings)),
    }
    if validation_fit_percent is not None:
        more["validation_fit_percent"] = percent(validation_fit_percent)
    return identified.file(name, origin, **more)


def provenance(
    method: str, *, source: str, records: Sequence[str], date: datetime.date, notes: str = ""
) -> dict[str, Any]:
    """Return the provenance of an identified model; arguments as for `model_file`."""
    return {
        "origin": "identified",
        "source": source,
        "method": method,
        "experiments": list(records),
        "date": date.isoformat(),
        "notes": notes,
    }


def write_model_file(path: Path, content: ModelFile) -> None:
    """Write a parameter file; raise OSError on failure."""
    write_parameters(path, _HEAD, content)


def uncertainty(estimate: ParameterEstimate) -> Mapping[str, Any]:
    """Return the uncertainty of the parameters for the parameter file."""
    deviation = estimate.standard_deviation
    # If a deviation is zero, its covariances are zero, so any scale avoids 0 / 0. Rounding may increase 1 slightly.
    scale = np.where(deviation > 0, deviation, 1.0)
    correlation = np.clip(estimate.covariance / np.outer(scale, scale), -1.0, 1.0)
    return {
        "parameters": list(estimate.names),
        "value": round_values(estimate.values),
        "standard_deviation": [float(f"{value:.4g}") for value in deviation],
        "correlation": [[round(float(value), _CORRELATION_DIGITS) for value in row] for row in correlation],
    }


def percent(fit: FloatArray) -> dict[str, float]:
    """Return FIT (2,) [%] by channel, rounded to the digits of a file."""
    return {channel: round(float(value), _PERCENT_DIGITS) for channel, value in zip(CHANNELS, fit, strict=True)}
