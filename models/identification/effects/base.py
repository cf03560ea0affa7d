"""Identification of SM together with the effects of the base."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffdrive_mpc.models.base_effects import BaseEffects
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.effects.fitting import EffectFit, covariance, fit_effects, weight_readings
from diffdrive_mpc.models.identification.effects.free_run import Point, base_track, free_run, sensor_experiments
from diffdrive_mpc.models.identification.effects.pose_sensor import pose_sensor
from diffdrive_mpc.models.identification.effects.selection import (
    BY_ENCODERS,
    EFFECTS,
    LINEAR,
    EffectTrial,
    Selection,
    select_effects,
)
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs.geometry import wheel_geometry
from diffdrive_mpc.models.logs.record import Record
from diffdrive_mpc.models.output_error import doubts
from diffdrive_mpc.models.output_error.experiment import YawSource, join_experiments, split_rows
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.output_error.validation import fit_percents
from diffdrive_mpc.models.structures.identified import IdentifiedModel, round_values
from diffdrive_mpc.models.structures.model_file import SmFile, TwoPoles
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone) of v and omega of the encoders and omega of the gyro at once, two "
    "real poles and a dead time for each channel, and effects of the base; an effect is selected only if it improves "
    "the prediction of held-out blocks of the records; outliers have smaller weights"
)
_BY_GYRO = " and omega of the gyro"
_NO_TRACK = "the track of the encoders is unknown, so steps of the wheels were not tested"
_NO_GYRO = "the log has no gyro, so tyre twist, veer and the encoders' lag were not tested"
# Parameters whose true value may be zero; a relative deviation is then meaningless.
_MAY_BE_ZERO = ("dead_time", "encoders.delay", "gyro.offset", "veer")


@dataclass(frozen=True)
class IdentifiedBase:
    """Model with base effects, and parameters of the sensors.

    Attributes
    ----------
    identified
        SM with the group `base_effects`; its v is measured by the encoders.
    effects
        Names of the selected effects.
    trials
        Trials of effects, in order.
    point
        All parameters of the free run, including those of the sensors.
    pose
        Delay of the poses, distance travelled per encoder distance, and pose mount; None if there are too few poses.
    points
        Parameters like `point`, one set per held-out block of the records, fitted without that block.
    """

    identified: IdentifiedModel
    effects: tuple[str, ...]
    trials: tuple[EffectTrial, ...]
    point: Point
    pose: ParameterEstimate | None
    points: tuple[Point, ...] = ()

    def readings(self, records: Sequence[Record]) -> list[FloatArray]:
        """Simulate the readings (K, p) of each record in one free run; see `sensor_experiments`."""
        return self._simulate(self.point, records)

    def body_twists(self, records: Sequence[Record]) -> list[FloatArray]:
        """Simulate true v [m/s] and yaw rate [rad/s] (K, 2) of each record in one free run, without sensor errors."""
        ideal = {name: value for name, value in self.point.items() if name != "encoders.lag"}
        ideal |= {"encoders.delay": 0.0, "gyro.offset": 0.0}
        travel = self.pose.value("pose.travel") if self.pose else 1.0
        twists = []
        for run in self._simulate(ideal, records):
            twists.append(np.column_stack([travel * run[:, 0], run[:, -1]]))
        return twists

    def fit_percent(self, records: Sequence[Record]) -> FloatArray:
        """Compute the pooled FIT (p,) [%] of v and omega of the encoders, and omega of the gyro.

        Raises
        ------
        ValueError
            If `sensor_experiments` raises it.
        """
        return fit_percents(self.readings(records), sensor_experiments(records, self.identified.yaw))

    def refitted(self, records: Sequence[Record]) -> IdentifiedModel:
        """Refit the model with the selected effects to other records; the statistics remain those of `identified`.

        Raises
        ------
        ValueError
            If `sensor_experiments` raises it.
        """
        linear = LINEAR if self.identified.yaw == "gyro" else BY_ENCODERS
        selected = [name for effect in self.effects for name in EFFECTS[effect]]
        free = [name for name in (*linear, *selected) if name in self.point and name in effect_settings().parameters]
        data = weight_readings(join_experiments(sensor_experiments(records, self.identified.yaw)), self.point)
        point = fit_effects(self.point, free, data, near=True).point
        content = {**_linear_content(point), "base_effects": effects_content(_build_effects(point, None))}
        return replace(self.identified, content=content)

    def _simulate(self, point: Point, records: Sequence[Record]) -> list[FloatArray]:
        experiments = sensor_experiments(records, self.identified.yaw)
        return split_rows([free_run(point, run) for run in join_experiments(experiments)], experiments)


def identify_with_effects(
    records: Sequence[Record],
    *,
    yaw: YawSource = "gyro",
    encoder_track: float | None = None,
    limits: Mapping[str, float] | None = None,
    on_trial: Callable[[str], None] | None = None,
) -> IdentifiedBase:
    """Identify SM and the effects of the base.

    `models.base_effects` defines the effects and states their sources. For a linear base, no effect is selected. The
    gyro is the reference for time and true yaw rate; delay and lag of the encoders are relative to the gyro.

    Parameters
    ----------
    records
        Records with encoders and gyro. Poses, if present, determine the pose mount and the distance travelled per
        encoder distance.
    yaw
        Sensor of omega. Without a gyro, only effects visible in the encoders are tested, and poses are not used.
    encoder_track
        Track for the computation of the encoders' yaw rate [m]; by default from the records' wheel speeds. If both are
        unknown, the track is identified together with the top speed, and steps of the wheels are not tested.
    limits
        Limits of channels at which the plain model clips the command; they are tested as an effect.
    on_trial
        Function that is called with the name of the effect of the next trial.

    Raises
    ------
    ValueError
        If a record lacks a sensor, a reading never changes, or the records are too short.
    """
    geometry = wheel_geometry(records)
    track = encoder_track or (geometry.track if geometry else None)
    selection = select_effects(join_experiments(sensor_experiments(records, yaw)), track, on_trial, limits)
    fit = selection.fit
    pose = pose_sensor(records, fit.point) if yaw == "gyro" else None
    effects = _build_effects(fit.point, pose)
    untested = [Doubt("unknown track", _NO_TRACK)] if track is None else []
    untested += [Doubt("unseen effects", _NO_GYRO)] if yaw != "gyro" else []
    parameters = _parameters(selection)
    identified = IdentifiedModel(
        schema=SmFile,
        content={**_linear_content(fit.point), "base_effects": effects_content(effects)},
        parameters=parameters,
        offset=np.array([0.0, fit.point["gyro.offset"]]),
        yaw=yaw,
        method=METHOD if yaw == "gyro" else METHOD.replace(_BY_GYRO, ""),
        fits=(),
        warnings=(*untested, *_doubts(fit, parameters)),
    )
    return IdentifiedBase(identified, selection.effects, selection.trials, fit.point, pose, selection.points)


def effects_content(effects: BaseEffects) -> Mapping[str, Any]:
    """Return the group `base_effects` of a model file, without absent effects."""
    return {name: round_values(values) for name, values in effects.model_dump(exclude_none=True).items()}


def _linear_content(point: Point) -> Mapping[str, Any]:
    """Return the keys of the model file for the linear dynamics."""
    channels = {
        channel: {
            "gain": point[f"gain.{channel}"],
            "natural_frequency": 1.0 / point[f"lag.{channel}"],
            "damping": point.get(f"damping.{channel}", 1.0),
        }
        for channel in CHANNELS
    }
    return {
        "dead_time": round_values({channel: point[f"dead_time.{channel}"] for channel in CHANNELS}),
        "channels": round_values(channels),
    }


def _build_effects(point: Point, pose: ParameterEstimate | None) -> BaseEffects:
    effects: dict[str, Any] = {}
    if any(f"limit.{channel}" in point for channel in CHANNELS):
        effects["twist_range"] = {channel: point.get(f"limit.{channel}") for channel in CHANNELS}
    if "slew.v" in point:
        effects["twist_slew"] = {channel: point[f"slew.{channel}"] for channel in CHANNELS}
    if any(name in point for name in ("wheels.resolution", "wheels.top_speed")):
        effects["wheel_command"] = {
            "track": base_track(point),
            "resolution": point.get("wheels.resolution", 0.0),
            "coasting_speed": point.get("wheels.coasting", 0.0),
            "top_speed": point.get("wheels.top_speed"),
        }
    if "relaxation" in point:
        effects["yaw_relaxation"] = {"angle": point["relaxation"]}
    if "veer" in point:
        effects["veer"] = {"yaw_per_metre": point["veer"]}
    if pose:
        effects["pose_mount"] = {name: pose.value(f"mount.{name}") for name in ("ahead", "left", "heading")}
    return BaseEffects.model_validate(effects)


def _parameters(selection: Selection) -> ParameterEstimate:
    """Return the free parameters with their names in model files, and the track that follows from the gains."""
    fit = selection.fit
    has_wheel_effect = any(name in selection.effects for name in EFFECTS if name.endswith("of the wheels"))
    names = tuple(_file_name(name) for name in fit.free) + (("wheels.track",) if has_wheel_effect else ())

    def file_values(estimates: FloatArray) -> FloatArray:
        point = {**fit.point, **dict(zip(fit.free, estimates.tolist(), strict=True))}
        values = [_file_value(name, point[name]) for name in fit.free]
        return np.array(values + ([base_track(point)] if has_wheel_effect else []))

    values = np.array([fit.point[name] for name in fit.free])
    return ParameterEstimate(fit.free, values, covariance(fit, selection.data)).derived(names, file_values)


def _file_name(name: str) -> str:
    kind, _, channel = name.partition(".")
    if channel not in CHANNELS or kind == "slew":
        return name
    return f"{channel}.{'natural_frequency' if kind == 'lag' else kind}"


def _file_value(name: str, value: float) -> float:
    return 1.0 / value if name in ("lag.v", "lag.omega") else value


def _delays(fit: EffectFit, parameters: ParameterEstimate) -> ParameterEstimate:
    """Compute the delay (2,) of v and omega [s]: dead time plus both lags."""
    file_parameters = {_file_name(name): _file_value(name, value) for name, value in fit.point.items()}

    def delays(estimates: FloatArray) -> FloatArray:
        point = {**file_parameters, **dict(zip(parameters.names, estimates.tolist(), strict=True))}
        values = [[point.get(f"{channel}.{name}", 1.0) for name in TwoPoles.model_fields] for channel in CHANNELS]
        dead_time = [point[f"{channel}.dead_time"] for channel in CHANNELS]
        return np.add(dead_time, [TwoPoles.lag(poles) for poles in values])

    return parameters.derived(CHANNELS, delays)


def _doubts(fit: EffectFit, parameters: ParameterEstimate) -> list[Doubt]:
    nonzero = [name for name in parameters.names if not any(part in name for part in _MAY_BE_ZERO)]
    delays = _delays(fit, parameters)
    result = [*doubts.uncertain_parameters(parameters.part(nonzero), delays=delays), *doubts.uncertain_delays(delays)]
    for name, (low, high, _) in effect_settings().parameters.items():
        # Zero is a valid result for an effect; a value at any other bound is not.
        if name in fit.point and fit.point[name] in (low, high) and fit.point[name] != 0.0:
            if name == "encoders.delay" and fit.point[name] < 0.0:
                lag = f", with a lag of {fit.point['encoders.lag']:.2g} s" if "encoders.lag" in fit.point else ""
                text = (
                    f"encoders.delay = {fit.point[name]:.4g} lies at a bound of the search{lag}: encoders cannot lead "
                    "the gyro, so the encoder delay in the mapping is too large, or the gyro is delayed"
                )
                result.append(Doubt("time shift", text))
                continue
            text = f"{name} = {fit.point[name]:.4g} lies at a bound of the search: the data do not determine it"
            result.append(Doubt("effect", text))
    return result
