"""Comparison of a twin and the identified velocity model on held-out rows of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects, PoseMount, respond
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.effects.free_run import free_run
from diffdrive_mpc.models.identification.fit.poses import PoseDrift, pose_drift
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray, ReadOnlyArrays
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, join_experiments, split_rows
from diffdrive_mpc.models.output_error.input_limits import limits_in
from diffdrive_mpc.models.output_error.validation import pooled_fit_percent
from diffdrive_mpc.models.structures.model_file import ModelFile, build_model
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc_extras.twin.fitting import TwinFit
from diffdrive_mpc_extras.twin.free_run import cut_stretch, drive, sensor_readings
from diffdrive_mpc_extras.twin.nominal import Nominal
from diffdrive_mpc_extras.twin.settings import twin_settings

_MOTOR_LOOP_LAG = 0.03
"""Approximate part of a model's lag that the control loops of the motors cause [s]."""
_MIN_LAG = 0.01


@dataclass(frozen=True)
class IdentifiedModel:
    """Identified velocity model with the sensors of a log.

    Attributes
    ----------
    model, effects
        Velocity model, and effects of the base.
    point
        Parameters of a model with effects, by the names of `models.identification.effects.free_run`; else empty.
    sensors
        "encoders.yaw_ratio", "gyro.offset", and optionally "encoders.delay" and "encoders.lag".
    """

    model: VelocityModel
    effects: BaseEffects
    point: Mapping[str, float]
    sensors: Mapping[str, float]

    @property
    def limits(self) -> FloatArray:
        """(2,) levels at which the robot clips v [m/s] and omega [rad/s]; the larger of both directions."""
        return np.asarray(limits_in(self.effects)[:, :2].max(axis=1))

    def readings(self, run: SampledExperiment) -> FloatArray:
        """Simulate v of the encoders [m/s] and omega of the model [rad/s] (K, 2) from commands and first readings."""
        if self.point:
            return np.asarray(free_run(self.point, run)[:, [0, -1]])
        return np.asarray(self.body(run) + np.array([0.0, self.sensors["gyro.offset"]]))

    def body(self, run: SampledExperiment) -> FloatArray:
        """Simulate v in encoder metres [m/s] and the true yaw rate [rad/s] (K, 2)."""
        first = np.array([run.outputs[np.argmax(run.counts[:, row]), row] for row in (0, -1)])
        start = np.linalg.solve(self.model.dc_gain, first - np.array([0.0, self.sensors["gyro.offset"]]))
        return respond(self.model, self.effects, run.inputs, run.dt, start).body

    def start(self, nominal: Nominal) -> dict[str, float]:
        """Return initial values of a twin's fit that approximate this model."""
        gain, dead_time = self.model.dc_gain, float(self.model.dead_time.mean())
        lag = np.maximum(self.model.lag - dead_time - _MOTOR_LOOP_LAG, _MIN_LAG)
        ratio = self.sensors["encoders.yaw_ratio"]
        values = {
            "dead_time": dead_time,
            "gain_v": float(gain[0, 0]),
            "lag_v": float(lag[0]),
            "lag_omega": float(lag[1]),
            "track": float(gain[1, 1] * ratio),
        }
        if ratio > 1.0:
            # Coulomb friction: effective over geometric track is 1 + (wheel base / track)^2.
            wheel_base = nominal.track_of_encoders * float(np.sqrt(ratio - 1.0))
            values["wheel_base"] = wheel_base / nominal.robot.twin.chassis.wheel_base
        if self.effects.twist_slew is not None:
            slews = {f"slew_{channel}": getattr(self.effects.twist_slew, channel) for channel in CHANNELS}
            values |= {name: float(slew) for name, slew in slews.items() if slew is not None}
        if self.effects.veer is not None:
            values["veer"] = -self.effects.veer.yaw_per_metre * nominal.track_of_encoders * ratio
        names = {"encoders.delay": "encoders_delay", "encoders.lag": "encoders_lag", "gyro.offset": "gyro_offset"}
        return values | {names[name]: value for name, value in self.sensors.items() if name in names}


def identified_model(content: ModelFile, runs: Sequence[SampledExperiment]) -> IdentifiedModel:
    """Build the model of a file with the sensors of a log; sensors that the file lacks are estimated from `runs`.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file has base effects, but not the sensors that they were identified with.
    """
    model, effects = build_model(content), content.base_effects
    estimates: dict[str, float] = {}
    if content.uncertainty is not None:
        estimates = dict(zip(content.uncertainty.parameters, content.uncertainty.value, strict=True))
    sensors = {name: estimates[name] for name in estimates if name.startswith(("encoders.", "gyro."))}
    if "encoders.yaw_ratio" not in sensors:
        sensors["encoders.yaw_ratio"] = _yaw_ratio(runs)
    motion_effects = effects.model_copy(update={"pose_mount": None, "twist_range": None})
    if "gyro.offset" not in sensors:
        motion_effects = motion_effects.model_copy(update={"twist_slew": None})
    if motion_effects == BaseEffects():
        without_offset = IdentifiedModel(model, effects, {}, sensors | {"gyro.offset": 0.0})
        sensors.setdefault("gyro.offset", _gyro_offset(without_offset, runs))
        return IdentifiedModel(model, effects, {}, sensors)
    if "gyro.offset" not in sensors or content.structure != "sm":
        raise ConfigError(
            f"model '{content.name}' has base effects without the sensors that they were identified with; "
            "use a file that `identify --effects` wrote"
        )
    return IdentifiedModel(model, effects, _free_run_parameters(content.model_dump(), effects, sensors), sensors)


def _free_run_parameters(
    content: Mapping[str, Any], effects: BaseEffects, sensors: Mapping[str, float]
) -> dict[str, float]:
    """Convert an SM file with effects to the parameters of `models.identification.effects.free_run`."""
    point: dict[str, float] = {"encoders.delay": 0.0, **sensors}
    for channel in CHANNELS:
        linear = content["channels"][channel]
        point[f"gain.{channel}"] = linear["gain"]
        point[f"lag.{channel}"] = 1.0 / linear["natural_frequency"]
        point[f"damping.{channel}"] = linear["damping"]
        point[f"dead_time.{channel}"] = content["dead_time"][channel]
    if effects.twist_range is not None:
        limits = {f"limit.{channel}": getattr(effects.twist_range, channel) for channel in CHANNELS}
        point |= {name: float(limit) for name, limit in limits.items() if limit is not None}
    if effects.twist_slew is not None:
        point |= {f"slew.{channel}": float(getattr(effects.twist_slew, channel) or np.inf) for channel in CHANNELS}
    if effects.wheel_command is not None:
        wheels = effects.wheel_command
        turning = point["gain.omega"] * point["encoders.yaw_ratio"]
        point["encoders.track"] = wheels.track * point["gain.v"] / turning
        point |= {"wheels.resolution": wheels.resolution, "wheels.coasting": wheels.coasting_speed}
        point |= {"wheels.top_speed": wheels.top_speed} if wheels.top_speed else {}
    if effects.yaw_relaxation is not None:
        point["relaxation"] = effects.yaw_relaxation.angle
    if effects.veer is not None:
        point["veer"] = effects.veer.yaw_per_metre
    return point


def _yaw_ratio(runs: Sequence[SampledExperiment]) -> float:
    """Estimate the ratio of the yaw rates of encoders and gyro; 1 without a gyro."""
    if runs[0].outputs.shape[1] < _GYRO_OUTPUTS:
        return 1.0
    readings = np.concatenate([run.outputs[run.counts[:, 1] & run.counts[:, 2]] for run in runs])
    wheels, gyro = (readings[:, 1:] - readings[:, 1:].mean(axis=0)).T
    product = float(wheels @ gyro)
    return float(wheels @ wheels) / product if product > 0 else 1.0


_GYRO_OUTPUTS = 3
"""Number of readings in a log with a gyro: v and omega of the encoders, omega of the gyro."""


def _gyro_offset(model: IdentifiedModel, runs: Sequence[SampledExperiment]) -> float:
    """Compute the mean residual of the model's omega [rad/s], within the bounds of the parameter."""
    low, high = (twin_settings().parameters["gyro_offset"].low, twin_settings().parameters["gyro_offset"].high)
    residuals = [(run.outputs[:, -1] - model.readings(run)[:, 1])[run.counts[:, -1]] for run in runs]
    return float(np.clip(np.mean(np.concatenate(residuals)), low, high))


@dataclass(frozen=True, repr=False)
class HeldOutPrediction(ReadOnlyArrays):
    """Prediction of a model or twin for one record.

    Attributes
    ----------
    readings
        (K, p) v [m/s] and omega [rad/s] of the encoders and, for a twin of a log with a gyro, omega of the gyro. An
        identified model has p = 2.
    body
        (K, 2) v in encoder metres [m/s] and true yaw rate [rad/s].
    """

    readings: FloatArray
    body: FloatArray


@dataclass(frozen=True)
class HeldOutScore:
    """Accuracy of the predictions of a model or twin on held-out records.

    Attributes
    ----------
    fit_percent
        FIT [%] of "v", "omega" and, for a twin, "omega of the encoders", pooled over the records.
    drift
        Pose error at each horizon; empty without poses.
    predictions
        Prediction for each record.
    """

    fit_percent: Mapping[str, float]
    drift: tuple[PoseDrift, ...]
    predictions: tuple[HeldOutPrediction, ...]


def predict_with_model(model: IdentifiedModel, experiments: Sequence[SampledExperiment]) -> list[HeldOutPrediction]:
    """Predict experiments with the identified model, in one free run over each section without gaps."""
    runs = join_experiments(experiments)
    outputs = split_rows([model.readings(run) for run in runs], experiments)
    body = split_rows([model.body(run) for run in runs], experiments)
    return [HeldOutPrediction(*rows) for rows in zip(outputs, body, strict=True)]


def predict_with_twin(
    fit: TwinFit, model: IdentifiedModel, experiments: Sequence[SampledExperiment]
) -> list[HeldOutPrediction]:
    """Predict experiments with the twin, as `predict_with_model`; the gain of `model` gives the initial motion."""
    runs = join_experiments(experiments)
    stretches = [cut_stretch(run, 0, run.samples, model.model.dc_gain) for run in runs]
    motions = drive(fit.robot, stretches)
    outputs = split_rows(
        [sensor_readings(motion, run, fit.values) for motion, run in zip(motions, runs, strict=True)], experiments
    )
    body = split_rows([motion.twist()[:, [0, 2]] for motion in motions], experiments)
    return [HeldOutPrediction(*rows) for rows in zip(outputs, body, strict=True)]


def fit_percent(predictions: Sequence[HeldOutPrediction], experiments: Sequence[SampledExperiment]) -> dict[str, float]:
    """Compute FIT [%] of v and omega, and of the encoders' omega if the prediction has a separate gyro omega."""
    width = experiments[0].outputs.shape[1]
    columns = {"v": (0, 0), "omega": (-1, -1)}
    if predictions[0].readings.shape[1] == width and width > len(columns):
        columns["omega of the encoders"] = (1, 1)
    return {
        name: pooled_fit_percent(
            [run.outputs[run.counts[:, output], output] for run in experiments],
            [
                prediction.readings[run.counts[:, output], column]
                for prediction, run in zip(predictions, experiments, strict=True)
            ],
        )
        for name, (column, output) in columns.items()
    }


def pose_drifts(
    records: Sequence[Record],
    predictions: Sequence[HeldOutPrediction],
    mount: Mapping[str, float] | None,
    *,
    travel: float,
    on_missing: Callable[[str], None] = lambda _reason: None,
) -> tuple[PoseDrift, ...]:
    """Compute the open-loop errors of the pose of the centre of rotation; empty without poses.

    Parameters
    ----------
    records
        Held-out records.
    predictions
        Prediction of each record.
    mount
        "pose.delay", "mount.ahead", "mount.left", "mount.heading" of `models.identification.effects.pose_sensor`.
    travel
        Metres travelled for each metre of v in the predictions [-].
    on_missing
        Called with the reason if a horizon is longer than the records.
    """
    if mount is None:
        return ()
    pose_mount = PoseMount(**{name: mount[f"mount.{name}"] for name in ("ahead", "left", "heading")})
    centred, twists = [], []
    for record, prediction in zip(records, predictions, strict=True):
        if record.pose is not None:
            centred.append(replace(record, pose=pose_mount.centre(record.pose)))
            twists.append(prediction.body * np.array([travel, 1.0]))
    drifts: list[PoseDrift] = []
    for horizon in identification_settings().horizons:
        try:
            drifts += pose_drift(centred, twists, pose_lag=max(mount["pose.delay"], 0.0), horizons=[horizon])
        except ValueError as error:
            on_missing(str(error))
    return tuple(drifts)
