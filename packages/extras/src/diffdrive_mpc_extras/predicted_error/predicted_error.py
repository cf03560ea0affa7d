"""Predicted tubes around a reference that contain a stated share of drives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc_extras.predicted_error.calibration import (
    FEATURES,
    CalibratedRanges,
    Direction,
    ErrorCalibration,
    ErrorScale,
    load_calibration,
    path_features,
)

_MAX_DURATION = 7200.0
"""Maximum duration of a reference [s]; a second needs 20 kB of memory."""
_SPEED_TOLERANCE = 5e-3
"""Tolerance of the maximum speed of a path, which may overshoot its bound slightly between samples [-]."""


@dataclass(frozen=True)
class ErrorTube:
    """Half widths of the tubes around the reference in one direction.

    Attributes
    ----------
    at_each_place
        (n,) half width of the tube that contains the stated share of drives at each place [m].
    everywhere
        (n,) half width of the tube that contains the stated share of whole drives [m].
    shares
        Contribution (n,) of each feature (see `FEATURES`) to the width [-].
    """

    at_each_place: FloatArray
    everywhere: FloatArray
    shares: Mapping[str, FloatArray]

    def scaled(self, factor: float) -> ErrorTube:
        """Return the tube, widened by a factor."""
        return replace(self, at_each_place=factor * self.at_each_place, everywhere=factor * self.everywhere)


@dataclass(frozen=True)
class WidestPlace:
    """Widest place of a tube.

    Attributes
    ----------
    index
        Row of the prediction.
    reasons
        Contributions of the features to the width at this place, in descending order [-].
    sentence
        Sentence with place, width and reasons.
    """

    index: int
    reasons: Mapping[str, float]
    sentence: str


@dataclass(frozen=True)
class PredictedError:
    """Predicted tracking error at n places of a reference.

    Attributes
    ----------
    reference
        Name of the reference.
    level
        Share of drives inside a tube [-].
    drives
        Description of the drives.
    time, arc_length
        (n,) time [s] and arc length [m] from the start.
    pose, twist
        (n, 3) x [m], y [m], theta [rad]; (n, 2) v [m/s], omega [rad/s] of the reference.
    lateral, along
        Tubes of the lateral and of the longitudinal error.
    warnings
        Reasons why the tubes may be too narrow: speeds of the path or delays of the model above the calibrated range.
    """

    reference: str
    level: float
    drives: str
    time: FloatArray
    arc_length: FloatArray
    pose: FloatArray
    twist: FloatArray
    lateral: ErrorTube
    along: ErrorTube
    warnings: tuple[str, ...] = ()

    def widest(self, direction: Direction = "lateral") -> WidestPlace:
        """Return the widest place of the tube in a direction, with the reasons."""
        tube: ErrorTube = getattr(self, direction)
        index = int(np.argmax(tube.everywhere))
        shares = {name: float(share[index]) for name, share in tube.shares.items()}
        reasons = dict(sorted(shares.items(), key=lambda item: -item[1]))
        causes = ", ".join(
            f"{FEATURES[name]} {100 * share:.0f} %" for name, share in list(reasons.items())[:3] if share > 0
        )
        x, y, _ = self.pose[index]
        place = f"after {self.arc_length[index]:.2f} m ({self.time[index]:.2f} s; x {x:.2f} m, y {y:.2f} m)"
        width = f"{1e3 * tube.at_each_place[index]:.1f} mm there, {1e3 * tube.everywhere[index]:.1f} mm everywhere"
        contributions = f"; contributions: {causes}" if causes else ""
        return WidestPlace(index, reasons, f"{direction}: worst {place}: {width}{contributions}")


def check_origin(model: VelocityModel | NonlinearModel) -> None:
    """Raise ValueError for a model with assumed parameters; a model without an origin counts as identified."""
    if model.provenance.get("origin") == "assumed":
        raise ValueError(
            f"model '{model.name}': its provenance.origin is assumed, and a prediction needs published or identified "
            "parameters; identify the model on this robot, or use a configuration with an identified model"
        )


def predict_tubes(
    reference: Reference,
    config: ControllerConfig,
    lag: FloatArray,
    population: str,
    calibration: ErrorCalibration | None = None,
) -> PredictedError:
    """Predict the tracking error of a reference that was already checked; `predict_error` checks it first.

    Parameters
    ----------
    reference
        Finite reference within the limits.
    config, lag
        Configuration of the controller, and lag (2,) of its model, dead time included [s].
    population
        Name of a population of the calibration.
    calibration
        Calibration, by default the shipped calibration.

    Raises
    ------
    ConfigError, ValueError
        If the population does not exist, or the duration of the reference is zero or above two hours.
    """
    calibration = calibration or load_calibration()
    drives = calibration.population(population)
    if not 0.0 < reference.duration <= _MAX_DURATION:
        raise ValueError(
            f"reference '{reference.name}': the duration is {reference.duration:g} s, but must be above 0 and at most "
            f"{_MAX_DURATION:g} s; split the reference"
        )
    dt = config.sample_time
    time = np.asarray(np.arange(max(2, int(np.ceil(reference.duration / dt)) + 1)) * dt, dtype=np.float64)
    sample = reference.sample(time)
    # Below the calibrated range, use its minimum: the calibration does not justify narrower tubes.
    min_lag = [calibration.calibrated.lag_v[0], calibration.calibrated.lag_omega[0]]
    features = path_features(sample.twist, dt, config, np.maximum(lag, min_lag))
    return PredictedError(
        reference.name,
        calibration.level,
        drives.description,
        time,
        sample.arc_length,
        sample.pose,
        sample.twist,
        _tube(features, drives.lateral),
        _tube(features, drives.along),
        _warnings(sample.twist, calibration.calibrated),
    )


def predict_error(
    controller: Controller,
    reference: Reference | str | Path,
    population: str = "drawn",
    calibration: str | Path | None = None,
) -> PredictedError:
    """Predict the tracking error of a reference; the controller does not change.

    Parameters
    ----------
    controller
        Controller of the planned drive.
    reference
        Trajectory, name or path, as for `Controller.start`.
    population
        Name of a population of the calibration; "drawn" are robots of the market with user-supplied configurations.
    calibration
        Calibration file with the population, by default the shipped calibration.

    Returns
    -------
    PredictedError
        Tubes that contain 95 % of the drives at each place, and 95 % of whole drives; with `warnings` if the path is
        faster, or the delay of the robot longer, than in the calibration.

    Raises
    ------
    ArgumentError, ConfigError, ValueError
        As `Controller.start`; also if the population does not exist, the model parameters are assumed, or the duration
        of the reference is zero or above two hours.
    """
    check_origin(controller.model)
    checked_reference = controller.checked_reference(reference)
    loaded, lag = load_calibration(calibration), controller.model.lag
    predicted = predict_tubes(checked_reference, controller.config, lag, population, loaded)
    return replace(predicted, warnings=(*predicted.warnings, *_lag_warnings(lag, loaded.calibrated)))


def _lag_warnings(lag: FloatArray, calibrated: CalibratedRanges) -> tuple[str, ...]:
    return tuple(
        f"dead time plus lag of {channel} is {value:.3g} s, the calibrated range is {low:g} to {high:g} s: the tubes "
        "may be too narrow"
        for channel, value, (low, high) in zip(CHANNELS, lag, (calibrated.lag_v, calibrated.lag_omega), strict=True)
        if value > high
    )


def _warnings(twist: FloatArray, calibrated: CalibratedRanges) -> tuple[str, ...]:
    maxima = np.abs(twist).max(axis=0)
    rows = (("speed", maxima[0], calibrated.v, "m/s"), ("yaw rate", maxima[1], calibrated.omega, "rad/s"))
    return tuple(
        f"the path's {name} reaches {maximum:.3g} {unit}, the calibrated range is {low:g} to {high:g} {unit}: the tubes"
        " may be too narrow"
        for name, maximum, (low, high), unit in rows
        if maximum > high * (1.0 + _SPEED_TOLERANCE)
    )


def _tube(features: FloatArray, scale: ErrorScale) -> ErrorTube:
    contributions = features * scale.row
    total = contributions.sum(axis=1)
    shares = {name: contributions[:, i] / total for i, name in enumerate(FEATURES) if scale.row[i] > 0.0}
    return ErrorTube(scale.at_each_place * total, scale.everywhere * total, shares)
