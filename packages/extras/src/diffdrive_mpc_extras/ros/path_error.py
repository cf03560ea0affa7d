"""The predicted error in the node: the limit that paths of `follow_path` keep to, and the answer of `~/predict_error`.

Needs no ROS. A prediction takes about a millisecond for a path of a minute, so it is made in the side process.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.planned.lay import Laid
from diffdrive_mpc_extras.predicted_error.calibration import ErrorCalibration, load_calibration
from diffdrive_mpc_extras.predicted_error.predicted_error import (
    ErrorTube,
    PredictedError,
    check_lag,
    check_origin,
    predict_tubes,
)

_SLOWER = (0.8, 0.6, 0.4, 0.2)
"""Shares of speed and acceleration at which a path is tried that has too wide a tube at full speed [-]."""


@dataclass(frozen=True)
class ErrorPredictor:
    """Predicts errors of references for the model of a controller; it can be sent to the side process.

    Attributes
    ----------
    lag
        (2,) of the model [s].
    population
        Which drives count; `calibration` has it.
    calibration
        Coefficients and quantiles.
    """

    lag: FloatArray
    population: str
    calibration: ErrorCalibration

    @classmethod
    def of(cls, controller: Controller, settings: NodeSettings) -> ErrorPredictor:
        """Read the calibration; ConfigError or ValueError where it cannot be used, or not for this model."""
        calibration = load_calibration(settings.error_calibration or None)
        calibration.population(settings.error_population)
        check_origin(controller.model)
        check_lag(controller.model.lag, calibration.calibrated)
        return cls(controller.model.lag, settings.error_population, calibration)

    def predict(self, reference: Reference, config: ControllerConfig) -> PredictedError:
        """The prediction; raises ValueError where the reference lasts no time, or over two hours."""
        return predict_tubes(reference, config, self.lag, self.population, self.calibration)

    def summary(self, reference: Reference, config: ControllerConfig) -> str:
        """The prediction in one line of JSON, see `_summary`."""
        return json.dumps(_summary(self.predict(reference, config), self.population))


def _summary(predicted: PredictedError, population: str) -> dict[str, object]:
    """Widest place of both tubes: half width [m], time [s] and distance since the start [m], reasons, and warnings."""

    def widest(tube: ErrorTube, words: str, index: int) -> dict[str, object]:
        return {
            "at_each_place": round(float(tube.at_each_place[index]), 5),
            "everywhere": round(float(tube.everywhere[index]), 5),
            "time": round(float(predicted.time[index]), 3),
            "arc_length": round(float(predicted.arc_length[index]), 3),
            "words": words,
        }

    lateral, along = predicted.widest("lateral"), predicted.widest("along")
    return {
        "reference": predicted.reference,
        "level": predicted.level,
        "population": population,
        "lateral": widest(predicted.lateral, lateral.sentence, lateral.index),
        "along": widest(predicted.along, along.sentence, along.index),
        "warnings": list(predicted.warnings),
    }


def lay_within_limit(
    lay: Callable[[TrajectoryLimits], Laid],
    limits: TrajectoryLimits,
    settings: NodeSettings,
    predictor: ErrorPredictor,
    config: ControllerConfig,
    speed: float = 0.0,
) -> Laid:
    """Lay a path whose predicted error keeps to `follow_error_limit`, slower where the settings allow that.

    A reference that began below the present `speed` [m/s] of the robot would pull it back: a moving robot is slowed
    no further than that, and otherwise refused, so that it stands when the next path comes.

    Raises ConfigError, which says by how much and where, if no allowed speed keeps to it.
    """
    slower = _SLOWER if settings.follow_error_response == "slow" else ()
    shares = (1.0, *(share for share in slower if share * limits.v >= speed))
    complaints = []
    for share in shares:
        laid = lay(_slowed(limits, share))
        try:
            complaint = _complaint(predictor.predict(laid.reference, config), settings.follow_error_limit)
        except ValueError as error:
            raise ConfigError(f"path: follow_error_limit cannot be checked: {error}") from error
        if not complaint:
            return replace(laid, speed_share=share)
        complaints.append(complaint)
    slowest = f"; at {100 * shares[-1]:g} % of this speed: {complaints[-1]}" if complaints[1:] else ""
    raise ConfigError(
        f"path: {complaints[0]}{slowest}. Plan an easier path, lower follow_speed_share, or raise follow_error_limit"
    )


def _complaint(predicted: PredictedError, limit: float) -> str:
    """Say why a path is not known to keep to the limit [m]; empty where it is."""
    width = float(predicted.lateral.everywhere.max())
    if width > limit:
        return (
            f"its predicted error is {1e3 * width:.1f} mm, follow_error_limit is {1e3 * limit:.1f} mm "
            f"({predicted.widest('lateral').sentence})"
        )
    return predicted.warnings[0] if predicted.warnings else ""


def _slowed(limits: TrajectoryLimits, share: float) -> TrajectoryLimits:
    names = ("v", "omega", "v_acceleration", "omega_acceleration")
    return replace(limits, **{name: share * getattr(limits, name) for name in names})
