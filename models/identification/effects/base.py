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
from diffdrive_mpc.models.structures.identified import IdentifiedModel, rounded
from diffdrive_mpc.models.structures.model_file import SmFile, TwoPoles
from diffdrive_mpc.models.velocity_model import CHANNELS

METHOD = (
    "output error (simulation from commands alone) of v and omega of the encoders and omega of the gyro at once, two "
    "real poles and a dead time for each channel, effects of the base around them; each effect tried in turn and kept "
    "only if it predicts held-out blocks of the records better; outliers held back"
)
_BY_GYRO = " and omega of the gyro"
_NO_TRACK = "the track of the encoders is unknown: steps of the wheels were not tried"
_NO_GYRO = "without a gyro, twist of the tyres, veer and the encoders' lag were not tried"
# Parameters that may be zero, so that a relative deviation is meaningless.
_MAY_BE_ZERO = ("dead_time", "encoders.delay", "gyro.offset", "veer")


@dataclass(frozen=True)
class IdentifiedBase:
    """A model with base effects, and the parameters of the sensors.

    Attributes
    ----------
    identified
        The model: SM with the group `base_effects`. Its v is measured by the encoders.
    effects
        Names of the selected effects.
    trials
        Trials of effects, in order.
    point
        All parameters of the free run, sensors included.
    pose
        Delay of the poses, distance travelled per encoder distance, and pose mount; None if there are too few poses.
    points
        Parameters like `point`, one fit for each held-out block of the records.
    """

    identified: IdentifiedModel
    effects: tuple[str, ...]
    trials: tuple[EffectTrial, ...]
    point: Point
    pose: ParameterEstimate | None
    points: tuple[Point, ...] = ()

    def readings(self, records: Sequence[Record]) -> list[FloatArray]:
        """Simulate the readings (K, p) of each record in one free run: encoders' v and omega, and omega of a gyro."""
        return self._runs(self.point, records)

    def body_twists(self, records: Sequence[Record]) -> list[FloatArray]:
        """Simulate true v [m/s] and yaw rate [rad/s] without sensor errors: (K, 2) for each record, in one free run."""
        ideal = {name: value for name, value in self.point.items() if name != "encoders.lag"}
        ideal |= {"encoders.delay": 0.0, "gyro.offset": 0.0}
        travel = self.pose.value("pose.travel") if self.pose else 1.0
        twists = []
        for run in self._runs(ideal, records):
            twists.append(np.column_stack([travel * run[:, 0], run[:, -1]]))
        return twists

    def fit_percent(self, records: Sequence[Record]) -> FloatArray:
        """Compute the pooled FIT (p,) [%] of the encoders' v and omega and the gyro's omega.

        Raises
        ------
        ValueError
            As `sensor_experiments`.
        """
        return fit_percents(self.readings(records), sensor_experiments(records, self.identified.yaw))

    def refitted(self, records: Sequence[Record]) -> IdentifiedModel:
        """Refit the selected effects to other records; statistics remain those of `identified`.

        Raises
        ------
        ValueError
            As `sensor_experiments`.
        """
        linear = LINEAR if self.identified.yaw == "gyro" else BY_ENCODERS
        selected = [name for effect in self.effects for name in EFFECTS[effect]]
        free = [name for name in (*linear, *selected) if name in self.point and name in effect_settings().parameters]
        data = weight_readings(join_experiments(sensor_experiments(records, self.identified.yaw)), self.point)
        point = fit_effects(self.point, free, data, near=True).point
        content = {**_linear(point), "base_effects": rounded_effects(_effects(point, None))}
        return replace(self.identified, content=content)

    def _runs(self, point: Point, records: Sequence[Record]) -> list[FloatArray]:
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

    The effects are defined in `models.base_effects`, with sources; none is selected for a linear base. The gyro is the
    reference for time and true yaw rate: delay and lag of the encoders are estimated relative to it.

    Parameters
    ----------
    records
        Records with encoders and gyro. Poses, if present, determine the pose mount and the distance travelled per
        encoder distance.
    yaw
        Sensor of omega. Without a gyro only effects visible to the encoders are tried, and poses are not used.
    encoder_track
        Track with which the encoders' yaw rate was computed [m]; by default from the records' wheel speeds. If neither
        is known, the track is identified together with the top speed, and steps of the wheels are not tried.
    limits
        Limits of channels whose command is clipped according to the plain model: tried as an effect.
    on_trial
        Called with the name of the effect of the next trial.

    Raises
    ------
    ValueError
        If a record has no encoders or gyro, a reading never changes, or the records are too short.
    """
    geometry = wheel_geometry(records)
    track = encoder_track or (geometry.track if geometry else None)
    selection = select_effects(join_experiments(sensor_experiments(records, yaw)), track, on_trial, limits)
    fit = selection.fit
    pose = pose_sensor(records, fit.point) if yaw == "gyro" else None
    effects = _effects(fit.point, pose)
    untried = [Doubt("unknown track", _NO_TRACK)] if track is None else []
    untried += [Doubt("unseen effects", _NO_GYRO)] if yaw != "gyro" else []
    parameters = _parameters(selection)
    identified = IdentifiedModel(
        schema=SmFile,
        content={**_linear(fit.point), "base_effects": rounded_effects(effects)},
        parameters=parameters,
        offset=np.array([0.0, fit.point["gyro.offset"]]),
        yaw=yaw,
        method=METHOD if yaw == "gyro" else METHOD.replace(_BY_GYRO, ""),
        fits=(),
        warnings=(*untried, *_doubts(fit, parameters)),
    )
    return IdentifiedBase(identified, selection.effects, selection.trials, fit.point, pose, selection.points)


def rounded_effects(effects: BaseEffects) -> Mapping[str, Any]:
    """Return the group `base_effects` of a model file, without absent effects."""
    return {name: rounded(values) for name, values in effects.model_dump(exclude_none=True).items()}


def _linear(point: Point) -> Mapping[str, Any]:
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
        "dead_time": rounded({channel: point[f"dead_time.{channel}"] for channel in CHANNELS}),
        "channels": rounded(channels),
    }


def _effects(point: Point, pose: ParameterEstimate | None) -> BaseEffects:
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
    """Return the free parameters under their names in model files, with the track that follows from the gains."""
    fit = selection.fit
    wheels = any(name in selection.effects for name in EFFECTS if name.endswith("of the wheels"))
    names = tuple(_file_name(name) for name in fit.free) + (("wheels.track",) if wheels else ())

    def file_values(row: FloatArray) -> FloatArray:
        point = {**fit.point, **dict(zip(fit.free, row.tolist(), strict=True))}
        values = [_physical(name, point[name]) for name in fit.free]
        return np.array(values + ([base_track(point)] if wheels else []))

    values = np.array([fit.point[name] for name in fit.free])
    return ParameterEstimate(fit.free, values, covariance(fit, selection.data)).derived(names, file_values)


def _file_name(name: str) -> str:
    kind, _, channel = name.partition(".")
    if channel not in CHANNELS or kind == "slew":
        return name
    return f"{channel}.{'natural_frequency' if kind == 'lag' else kind}"


def _physical(name: str, value: float) -> float:
    return 1.0 / value if name in ("lag.v", "lag.omega") else value


def _delays(fit: EffectFit, parameters: ParameterEstimate) -> ParameterEstimate:
    """Compute the delay (2,) of v and omega [s]: dead time plus both lags."""
    known = {_file_name(name): _physical(name, value) for name, value in fit.point.items()}

    def delays(row: FloatArray) -> FloatArray:
        point = {**known, **dict(zip(parameters.names, row.tolist(), strict=True))}
        values = [[point.get(f"{channel}.{name}", 1.0) for name in TwoPoles.model_fields] for channel in CHANNELS]
        dead_time = [point[f"{channel}.dead_time"] for channel in CHANNELS]
        return np.add(dead_time, [TwoPoles.lag(poles) for poles in values])

    return parameters.derived(CHANNELS, delays)


def _doubts(fit: EffectFit, parameters: ParameterEstimate) -> list[Doubt]:
    nonzero = [name for name in parameters.names if not any(part in name for part in _MAY_BE_ZERO)]
    delays = _delays(fit, parameters)
    verdicts = [*doubts.uncertain_parameters(parameters.part(nonzero), delays=delays), *doubts.uncertain_delays(delays)]
    for name, (low, high, _) in effect_settings().parameters.items():
        # Zero is a valid result for an effect; a value at any other bound is not.
        if name in fit.point and fit.point[name] in (low, high) and fit.point[name] != 0.0:
            if name == "encoders.delay" and fit.point[name] < 0.0:
                lag = f", with a lag of {fit.point['encoders.lag']:.2g} s" if "encoders.lag" in fit.point else ""
                words = (
                    f"encoders.delay = {fit.point[name]:.4g} lies at a bound of the search{lag}: encoders cannot lead "
                    "the gyro, so the mapping subtracts too much delay from them, or the gyro is delayed"
                )
                verdicts.append(Doubt("time shift", words))
                continue
            words = f"{name} = {fit.point[name]:.4g} lies at a bound of the search: the data do not tell it"
            verdicts.append(Doubt("effect", words))
    return verdicts
