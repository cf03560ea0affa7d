"""Write `report.md` and `report.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.bench.identification.tables import (
    drift_table,
    effect_table,
    order_table,
    parameter_table,
    residual_table,
    score_table,
    slip_table,
)
from diffdrive_mpc.bench.machine import project_version
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.identification.estimate import Estimate
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import CHANNELS


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


def _parameters(estimate: Estimate) -> dict[str, dict[str, float | None]]:
    return {
        name: {"value": float(value), "standard_deviation": float(deviation) if math.isfinite(deviation) else None}
        for name, value, deviation in zip(estimate.names, estimate.values, estimate.standard_deviation, strict=True)
    }
