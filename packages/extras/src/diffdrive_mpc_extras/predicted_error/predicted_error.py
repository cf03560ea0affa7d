"""Tubes about a reference in which a stated share of drives stays, said before it is driven."""

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

_LONGEST = 7200.0
"""Maximum duration of a reference [s]: memory grows by 20 kB for each second."""
_ROUNDING = 5e-3
"""Between samples the speed of a path that is timed at the bound swings a little beyond it [-]."""


@dataclass(frozen=True)
class ErrorTube:
    """Half the width of a tube about the reference, to either side, in one direction.

    Attributes
    ----------
    at_each_place
        (n,) the stated share of drives is inside at this place [m].
    everywhere
        (n,) that share of drives is inside all the way [m].
    shares
        By feature (see `FEATURES`) its share (n,) of the width [-].
    """

    at_each_place: FloatArray
    everywhere: FloatArray
    shares: Mapping[str, FloatArray]

    def times(self, factor: float) -> ErrorTube:
        """Return the tube with `factor` times its width."""
        return replace(self, at_each_place=factor * self.at_each_place, everywhere=factor * self.everywhere)


@dataclass(frozen=True)
class WidestPlace:
    """Place of the maximum width of a tube.

    Attributes
    ----------
    index
        Row of the prediction.
    reasons
        Features by their share of the width there, the largest first.
    sentence
        Place, width and reasons in words.
    """

    index: int
    reasons: Mapping[str, float]
    sentence: str


@dataclass(frozen=True)
class PredictedError:
    """The tracking error of a reference that was not driven yet, at n places of it.

    Attributes
    ----------
    reference
        Its name.
    level
        Share of drives inside a tube [-].
    drives
        Which drives, in words.
    time, arc_length
        (n,) time [s] and distance [m] since the start.
    pose, twist
        (n, 3) x [m], y [m], theta [rad]; (n, 2) v [m/s], omega [rad/s] of the reference.
    lateral, along
        Distance from the path; ahead of the reference or behind it along the path.
    warnings
        Why the tubes may be too narrow, a sentence each: speeds of the path or delays of the model above those of the
        calibration. Empty if nothing speaks against them.
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
        """Locate the widest place of the tube of a direction, with the reasons."""
        tube: ErrorTube = getattr(self, direction)
        index = int(np.argmax(tube.everywhere))
        shares = {name: float(share[index]) for name, share in tube.shares.items()}
        reasons = dict(sorted(shares.items(), key=lambda item: -item[1]))
        why = ", ".join(
            f"{FEATURES[name]} {100 * share:.0f} %" for name, share in list(reasons.items())[:3] if share > 0
        )
        x, y, _ = self.pose[index]
        place = f"after {self.arc_length[index]:.2f} m ({self.time[index]:.2f} s; x {x:.2f} m, y {y:.2f} m)"
        width = f"{1e3 * tube.at_each_place[index]:.1f} mm there, {1e3 * tube.everywhere[index]:.1f} mm everywhere"
        made = f"; made of {why}" if why else ""
        return WidestPlace(index, reasons, f"{direction}: worst {place}: {width}{made}")


def check_origin(model: VelocityModel | NonlinearModel) -> None:
    """Raise ValueError for a model whose numbers nobody measured; one that does not say counts as identified."""
    if model.provenance.get("origin") == "assumed":
        raise ValueError(
            f"model '{model.name}': its provenance.origin is assumed, and errors are predicted for published or "
            "identified; identify the model on this robot, or take a configuration whose model was identified"
        )


def predict_tubes(
    reference: Reference,
    config: ControllerConfig,
    lag: FloatArray,
    population: str,
    calibration: ErrorCalibration | None = None,
) -> PredictedError:
    """Predict the tracking error of a checked reference; see `predict_error`, which checks it.

    Parameters
    ----------
    reference
        Finite, and within the limits.
    config, lag
        Of the controller and (2,) of its model [s].
    population
        Of `calibration`, by default the shipped one.

    Raises
    ------
    ConfigError, ValueError
        If there is no such population, or the reference lasts no time or longer than two hours.
    """
    calibration = calibration or load_calibration()
    drives = calibration.population(population)
    if not 0.0 < reference.duration <= _LONGEST:
        raise ValueError(
            f"reference '{reference.name}': it lasts {reference.duration:g} s; an error is predicted for more than 0 "
            f"and at most {_LONGEST:g} s, so give it in parts"
        )
    dt = config.sample_time
    time = np.asarray(np.arange(max(2, int(np.ceil(reference.duration / dt)) + 1)) * dt, dtype=np.float64)
    sample = reference.sample(time)
    # Below the range of the calibration nothing is known of a faster robot: its tube is no narrower.
    least = [calibration.calibrated.lag_v[0], calibration.calibrated.lag_omega[0]]
    features = path_features(sample.twist, dt, config, np.maximum(lag, least))
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
    """Predict the tracking error of a reference before it is driven; nothing of the controller changes.

    Parameters
    ----------
    controller
        Controller that would drive it.
    reference
        Trajectory, name or path, as for `Controller.start`.
    population
        Drives that count: "drawn", robots of the market whose users know what the configuration says; or one of
        `calibration`.
    calibration
        Calibration file that has the population; by default the shipped one.

    Returns
    -------
    PredictedError
        Tubes in which 95 % of the drives stay at each place, and on the whole path; with `warnings` if the path is
        faster, or the robot later, than those of the calibration.

    Raises
    ------
    ArgumentError, ConfigError, ValueError
        As `Controller.start`, and if there is no such population, the model's numbers are assumed, or the reference
        lasts no time or over two hours.
    """
    check_origin(controller.model)
    checked = controller.checked_reference(reference)
    calibrated = load_calibration(calibration)
    lag = controller.model.lag
    predicted = predict_tubes(checked, controller.config, lag, population, calibrated)
    return replace(predicted, warnings=(*predicted.warnings, *_lag_warnings(lag, calibrated.calibrated)))


def _lag_warnings(lag: FloatArray, calibrated: CalibratedRanges) -> tuple[str, ...]:
    return tuple(
        f"dead time plus lag of {channel} is {value:.3g} s, in the calibration {low:g} to {high:g} s: the tubes may be "
        "too narrow"
        for channel, value, (low, high) in zip(CHANNELS, lag, (calibrated.lag_v, calibrated.lag_omega), strict=True)
        if value > high
    )


def _warnings(twist: FloatArray, calibrated: CalibratedRanges) -> tuple[str, ...]:
    tops = np.abs(twist).max(axis=0)
    rows = (("speed", tops[0], calibrated.v, "m/s"), ("yaw rate", tops[1], calibrated.omega, "rad/s"))
    return tuple(
        f"the path's {name} reaches {top:.3g} {unit}, paths of the calibration {low:g} to {high:g} {unit}: the tubes "
        "may be too narrow"
        for name, top, (low, high), unit in rows
        if top > high * (1.0 + _ROUNDING)
    )


def _tube(features: FloatArray, scale: ErrorScale) -> ErrorTube:
    parts = features * scale.row
    whole = parts.sum(axis=1)
    shares = {name: parts[:, i] / whole for i, name in enumerate(FEATURES) if scale.row[i] > 0.0}
    return ErrorTube(scale.at_each_place * whole, scale.everywhere * whole, shares)
