"""Everything that one identification found, for people and for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.bench.machine import project_version
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.identification.fitting import Fitted
from diffdrive_mpc.models.identification.log_data import Data
from diffdrive_mpc.models.identification.poses import PoseResults
from diffdrive_mpc.models.identification.settings import report_settings
from diffdrive_mpc.models.identification.tables import (
    drift_table,
    effect_table,
    order_table,
    parameter_table,
    residual_table,
    score_table,
    slip_table,
)
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True)
class Outcome:
    """One identification.

    Attributes
    ----------
    name
        Of the model.
    data, fitted, poses
        What it was made from, the model with its scores, and what poses added.
    """

    name: str
    data: Data
    fitted: Fitted
    poses: PoseResults

    @property
    def warnings(self) -> tuple[str, ...]:
        """Everything that a user should know before trusting the model: of the log, the estimate and its scores."""
        found = [str(finding) for finding in self.data.findings if finding.severity == "warning"]
        found += [*self.data.warnings, *self.fitted.identified.warnings, *self.poses.warnings]
        if self.data.yaw == "encoders":
            found.append(
                "omega: the log has no gyro, so this is the yaw rate of the wheels; a skid-steered body turns less"
            )
        if self.fitted.geometry is None:
            found.append(
                "wheels: the log has no speeds of theirs: in config.yaml set limits.wheel_speed, wheels.track and "
                "wheels.encoder_track"
            )
        return tuple(dict.fromkeys([*found, *score_warnings(self.fitted), *mount_warnings(self.poses)]))


def score_warnings(fitted: Fitted) -> list[str]:
    """What FIT and residuals on the records held out say against the model."""
    limits = report_settings().warn
    found = []
    for row, channel in enumerate(CHANNELS):
        train, validation = float(fitted.train.fit_percent[row]), float(fitted.validation.fit_percent[row])
        if validation < limits.low_fit:
            found.append(
                f"{channel}: validation FIT {validation:.1f} %, below {limits.low_fit:g} %: little is explained"
            )
        if train - validation > limits.fit_drop:
            found.append(
                f"{channel}: FIT falls from {train:.1f} to {validation:.1f} % on data held out: they differ, or the "
                "model has too many parameters"
            )
        unexplained = fitted.validation.residuals.unexplained[row]
        j = int(np.argmax(unexplained))
        if unexplained[j] > limits.unexplained:
            found.append(
                f"{channel}: residuals follow past commands of {CHANNELS[j]} ({unexplained[j]:.1f} times the 95 % "
                "bound): the model misses part of the dynamics"
            )
    return found


def mount_warnings(poses: PoseResults) -> list[str]:
    """A sentence if poses are those of a point that the robot does not turn about."""
    place = {name.rpartition("_")[2].rpartition(".")[2]: poses.parameters.value(name) for name in poses.mount}
    if not place or np.hypot(place["ahead"], place["left"]) < report_settings().warn.lever_arm:
        return []
    return [
        f"poses: their point sits {place['ahead']:.3f} m ahead and {place['left']:.3f} m to the left of the centre of "
        "rotation: give the controller poses of that centre (models.base_effects.PoseMount)"
    ]


def write_json(outcome: Outcome, path: Path) -> None:
    """Write what a program reads: scores, pose errors, parameters and warnings. The same run gives the same file."""
    path.write_text(json.dumps(as_json(outcome), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def as_json(outcome: Outcome) -> dict[str, Any]:
    """The content of `report.json`; parameters found from poses stand behind "poses."."""
    fitted = outcome.fitted
    return {
        "model": fitted.identified.structure,
        "train_fit_percent": _channels(fitted.train.fit_percent),
        "validation_fit_percent": _channels(fitted.validation.fit_percent),
        "pose_error": [
            {
                "horizon_s": drift.horizon,
                "position_rmse_m": drift.position_rmse,
                "heading_rmse_rad": drift.heading_rmse,
            }
            for drift in outcome.poses.drift
        ],
        "parameters": _parameters(fitted.identified.parameters)
        | _parameters(outcome.poses.parameters.renamed("poses")),
        "warnings": list(outcome.warnings),
    }


def write_markdown(outcome: Outcome, figures: Mapping[str, str], day: date, path: Path) -> None:
    """Write what a person reads; `figures` are titles and relative paths, in the order to be shown."""
    path.write_text(markdown(outcome, figures, day), encoding="utf-8")


def markdown(outcome: Outcome, figures: Mapping[str, str], day: date) -> str:
    """The report as Markdown."""
    tables = [residual_table(outcome)]
    if outcome.poses.drift:
        tables.append(drift_table(outcome))
    if outcome.fitted.orders:
        tables.append(order_table(outcome))
    if outcome.fitted.base:
        tables.append(effect_table(outcome))
    tables.append(parameter_table("Parameters", outcome.fitted.identified.parameters))
    if outcome.poses.parameters.names:
        tables.append(parameter_table("Parameters from poses", outcome.poses.parameters))
    if outcome.poses.laws:
        tables.append(slip_table(outcome))
    parts = [f"# {outcome.name}", "", *_facts(outcome, day), "", score_table(outcome).markdown()]
    parts += ["## Warnings", "", *_bullets(outcome.warnings), ""]
    for title, name in figures.items():
        parts += [f"## {title}", "", f"![{title}](figures/{name})", ""]
    parts += [table.markdown() for table in tables]
    parts += [_findings(outcome).markdown()] if outcome.data.findings else []
    parts += ["## Stretches", ""]
    parts += _bullets([f"training: {record.name}" for record in outcome.data.train])
    parts += _bullets([f"validation: {record.name}" for record in outcome.data.validation])
    return "\n".join(parts).rstrip() + "\n"


def _facts(outcome: Outcome, day: date) -> list[str]:
    data, fitted = outcome.data, outcome.fitted
    spans = [sum(len(record.command) * record.dt for record in records) for records in (data.train, data.validation)]
    return _bullets(
        [
            f"{fitted.identified.structure.upper()} from {', '.join(data.logs)}: {fitted.identified.method}.",
            f"Identified from {spans[0]:.0f} s, tried on {spans[1]:.0f} s, {data.held_out}; "
            f"one sample every {data.train[0].dt:.6g} s.",
            f"omega is that of the {data.yaw}.",
            f"Estimation took {fitted.seconds:.1f} s.",
            f"diffdrive-mpc {project_version()}, {day.isoformat()}.",
        ]
    )


def _findings(outcome: Outcome) -> Table:
    rows = tuple((finding.severity, finding.kind, finding.place, finding.words) for finding in outcome.data.findings)
    return Table("Findings in the logs", ("severity", "kind", "where", "what"), rows, text_columns=4)


def _bullets(lines: Sequence[str]) -> list[str]:
    return [f"* {line}" for line in lines] or ["None."]


def _channels(values: FloatArray) -> dict[str, float]:
    return {channel: float(value) for channel, value in zip(CHANNELS, values, strict=True)}


def _parameters(estimate: ParameterEstimate) -> dict[str, dict[str, float | None]]:
    return {
        name: {"value": float(value), "standard_deviation": float(deviation) if math.isfinite(deviation) else None}
        for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True)
    }
