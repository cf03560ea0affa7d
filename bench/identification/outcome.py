"""Everything that one identification found, as report, figures and files take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.identification.data import Data
from diffdrive_mpc.bench.identification.fitting import Fitted
from diffdrive_mpc.bench.identification.poses import PoseResults
from diffdrive_mpc.bench.identification.settings import report_settings
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
