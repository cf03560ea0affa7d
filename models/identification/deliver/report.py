"""Report of an identification as text, Markdown and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from diffdrive_mpc.models.doubt import Doubt, lines
from diffdrive_mpc.models.identification.deliver.limits import limit_lines
from diffdrive_mpc.models.identification.deliver.tables import (
    delay_table,
    drift_table,
    effect_table,
    finding_table,
    order_table,
    parameter_table,
    residual_table,
    score_table,
)
from diffdrive_mpc.models.identification.deliver.trust import Trust, judge
from diffdrive_mpc.models.identification.fit.fitting import Fitted
from diffdrive_mpc.models.identification.fit.poses import PoseResults
from diffdrive_mpc.models.identification.fit.slip import SlipPrior
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.record import Finding, format_findings
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.stated_robot import ManufacturerRobot
from diffdrive_mpc.models.table import TextTable, plain_line, plain_text
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True, eq=False, repr=False)
class IdentificationReport:
    """Data and results of one identification; `str` returns the summary for the user.

    Attributes
    ----------
    name
        Name of the model.
    data, fitted, poses, slip
        Data of the logs, model with scores, results from poses, and initial slip estimate of the filter.
    day
        Date of the identification.
    robot
        Robot with values stated by the manufacturer; None if no robot is named.
    """

    name: str
    data: LogData
    fitted: Fitted
    poses: PoseResults
    slip: SlipPrior
    day: date
    robot: ManufacturerRobot | None = None

    def __repr__(self) -> str:
        """Format the name only, without arrays."""
        return f"<IdentificationReport {self.name!r}>"

    def __str__(self) -> str:
        """Format scores, pose errors, parameters and warnings."""
        tables = [*self.scores, *self._parameter_tables]
        warnings = "\n".join(f"warning: {warning}" for warning in self.warnings)
        return plain_text("\n\n".join([self.name, *map(str, tables), *([warnings] if warnings else [])]))

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts about the estimate and its scores."""
        predictor_doubts = self.fitted.predictor.doubts if self.fitted.predictor else ()
        doubts = [*self.data.warnings, *predictor_doubts, *self.fitted.identified.warnings, *self.poses.warnings]
        if self.data.yaw == "encoders":
            text = "omega: the log has no gyro; add one to a skid-steered robot, which turns less than its wheels"
            doubts.append(Doubt("no gyro", text))
        if self.fitted.geometry is None and self.data.stated_track is None and self.robot is None:
            text = (
                "wheels: neither the log nor the mapping (wheels.track) determines the track: set wheels.track, "
                "wheels.encoder_track and limits.wheel_speed in config.yaml"
            )
            doubts.append(Doubt("no wheels", text))
        return tuple(dict.fromkeys([*doubts, *score_doubts(self.fitted), *mount_doubts(self.poses)]))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings for the user, one line each: findings in the logs and `doubts` about the model."""
        return tuple(dict.fromkeys([*format_findings(self._findings), *lines(self.doubts)]))

    @property
    def _parameter_tables(self) -> list[TextTable]:
        identified, predictor = self.fitted.identified, self.fitted.predictor
        tables = [parameter_table("Parameters", predictor.estimate)] if predictor and predictor.estimate else []
        delays = [] if identified.delays is None else [delay_table(identified.delays)]
        title = f"Parameters of the linear model in addition to {predictor.title}" if predictor else "Parameters"
        return [*tables, *delays, parameter_table(title, identified.parameters, dead_times=not delays)]

    @property
    def objections(self) -> tuple[Finding | Doubt, ...]:
        """Findings in the logs that are more severe than notes, and `doubts`."""
        return (*self._findings, *self.doubts)

    @property
    def _findings(self) -> list[Finding]:
        return [finding for finding in self.data.findings if finding.severity != "note"]

    @property
    def findings_summary(self) -> list[str]:
        """Model, limits and, if available, a better mapping, each in one line."""
        model = self.fitted.identified.model
        gain, dead_time, lag = model.dc_gain, model.dead_time, model.lag - model.dead_time
        lags = [
            f"{channel} follows its command with gain {gain[i, i]:.3g} and delay {dead_time[i] + lag[i]:.2f} s "
            f"(dead time {dead_time[i]:.2f} s, lag {lag[i]:.2f} s)"
            for i, channel in enumerate(CHANNELS)
        ]
        if self.fitted.predictor is not None:
            linear = "in the accompanying linear model, which determines limits and tracks"
            lags[0] = f"{self.fitted.predictor.title}; {linear}, {lags[0]}"
        advice = [self.data.advice.sentence()] if self.data.advice else []
        limits = [f"Limits of commands: {'; '.join(self.limits)}."]
        return [f"Model: {'; '.join(lags)}.", *limits, *advice]

    @property
    def limits(self) -> list[str]:
        """Limits of the base that the log reaches, and limits that it does not reach."""
        return limit_lines(self.fitted.identified, (*self.data.train, *self.data.validation))

    def summary_lines(self) -> list[str]:
        """Return the summary of findings and the grade of the model."""
        return [*self.findings_summary, f"Trust: {self.verdict}."]

    @cached_property
    def trust(self) -> Trust:
        """Grade of the model, based on its logs."""
        return judge(self.data, self.fitted, self.doubts)

    @property
    def verdict(self) -> str:
        """Grade of the model with reasons in one line."""
        return str(self.trust)

    @property
    def scores(self) -> tuple[TextTable, ...]:
        """Tables of model quality: FIT and RMSE, and the open-loop pose error if there are poses."""
        return (score_table(self.fitted), *([drift_table(self.poses)] if self.poses.drift else []))

    @property
    def tables(self) -> list[TextTable]:
        """All tables in order, except the first table of `scores`."""
        fitted, poses = self.fitted, self.poses
        tables = [residual_table(fitted), *self.scores[1:]]
        if fitted.orders:
            tables.append(order_table(fitted.orders))
        if fitted.base:
            tables.append(effect_table(fitted.base))
        tables += self._parameter_tables
        if poses.parameters.names:
            tables.append(parameter_table("Parameters from poses", poses.parameters))
        if self.data.findings:
            tables.append(finding_table(self.data.findings))
        return tables

    def as_json(self) -> dict[str, Any]:
        """Convert the report to JSON values; names of parameters from poses start with "poses."."""
        fitted = self.fitted
        estimate = fitted.predictor.estimate if fitted.predictor else None
        return {
            "model": fitted.structure,
            "train_fit_percent": _by_channel(fitted.train.fit_percent),
            "validation_fit_percent": _by_channel(fitted.validation.fit_percent),
            "pose_error": [
                {
                    "horizon_s": drift.horizon,
                    "position_rmse_m": drift.position_rmse,
                    "heading_rmse_rad": drift.heading_rmse,
                }
                for drift in self.poses.drift
            ],
            "parameters": _parameters(fitted.identified.parameters)
            | (_parameters(estimate.renamed(fitted.structure)) if estimate else {})
            | _parameters(self.poses.parameters.renamed("poses")),
            "warnings": list(self.warnings),
        }

    def markdown(self, figures: Mapping[str, str] | None = None, first: Sequence[str] = ()) -> str:
        """Format the report as Markdown.

        Parameters
        ----------
        figures
            Relative paths by title, in order.
        first
            Lines that replace summary and grade, for instance after trial drives.
        """
        parts = [
            f"# {plain_line(self.name)}",
            "",
            *(first or _bullets(self.summary_lines())),
            "",
            *self._facts(),
            "",
            self.scores[0].markdown(),
        ]
        parts += ["## Warnings", "", *_bullets(self.warnings), ""]
        for title, path in (figures or {}).items():
            parts += [f"## {title}", "", f"![{title}]({path})", ""]
        parts += [table.markdown() for table in self.tables]
        parts += ["## Stretches", ""]
        parts += _bullets([f"training: {record.name}" for record in self.data.train])
        parts += _bullets([f"validation: {record.name}" for record in self.data.validation])
        return "\n".join(parts).rstrip() + "\n"

    def _facts(self) -> list[str]:
        data, fitted = self.data, self.fitted
        durations = [
            sum(len(record.command) * record.dt for record in records) for records in (data.train, data.validation)
        ]
        return _bullets(
            [
                f"{fitted.structure.upper()} from {', '.join(data.logs)}: {fitted.method}.",
                f"Identified from {durations[0]:.0f} s, validated on {durations[1]:.0f} s, {data.held_out}; "
                f"sample time {data.train[0].dt:.6g} s.",
                f"omega is measured by the {data.yaw}.",
                str(self.slip),
                f"Estimation took {fitted.seconds:.1f} s.",
                f"diffdrive-mpc {_version()}, {self.day.isoformat()}.",
            ]
        )


def score_doubts(fitted: Fitted) -> list[Doubt]:
    """Return the doubts from FIT and residuals on the held-out records."""
    limits = identification_settings().warn
    doubts = []
    for row, channel in enumerate(CHANNELS):
        train, validation = float(fitted.train.fit_percent[row]), float(fitted.validation.fit_percent[row])
        if validation < limits.low_fit:
            text = f"validation FIT {validation:.1f} % is below {limits.low_fit:g} %: the model explains too little"
            doubts.append(Doubt("low FIT", text).about(channel))
        if train - validation > limits.fit_drop:
            text = (
                f"FIT decreases from {train:.1f} to {validation:.1f} % on validation data: the data differ, or the "
                "model has too many parameters"
            )
            doubts.append(Doubt("FIT falls", text).about(channel))
        unexplained = fitted.validation.residuals.unexplained[row]
        column = int(np.argmax(unexplained))
        if unexplained[column] > limits.unexplained:
            text = (
                f"residuals follow past commands of {CHANNELS[column]} ({unexplained[column]:.1f} times the 95 % "
                "bound): the model misses part of the dynamics; try --structure ssm, a higher --order or --effects"
            )
            doubts.append(Doubt("missed dynamics", text).about(channel))
    return doubts


def mount_doubts(poses: PoseResults) -> list[Doubt]:
    """Return a doubt if the pose point is not the centre of rotation."""
    ahead, left = poses.place
    if not ahead and not left:
        return []
    text = (
        f"poses: the pose point is {ahead:.3f} m ahead and {left:.3f} m to the left of the centre of "
        "rotation: correct the static transform from base_link to the sensor, so that base_link is this centre"
    )
    return [Doubt("pose point", text)]


def _bullets(lines: Sequence[str]) -> list[str]:
    return [f"* {line}" for line in lines] or ["None."]


def _by_channel(values: FloatArray) -> dict[str, float]:
    return {channel: float(value) for channel, value in zip(CHANNELS, values, strict=True)}


def _parameters(estimate: ParameterEstimate) -> dict[str, dict[str, float | None]]:
    return {
        name: {"value": value, "standard_deviation": deviation if math.isfinite(deviation) else None}
        for name, value, deviation in estimate.rows
    }


def _version() -> str:
    try:
        return version("diffdrive-mpc")
    except PackageNotFoundError:  # source tree that is not installed
        return "unknown"
