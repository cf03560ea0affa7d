"""Fit the firmware of the digital twin such that a published velocity model predicts the measurements of the twin.

The published model has different lags of forward speed and yaw rate, but the motor loop has only one lag. Therefore,
the firmware filters each command channel with a separate lag; its track determines the yaw gain. All other parameters
of the twin are unchanged.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import yaml
from pydantic import Field

from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.discrete_model import DiscreteModel
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import load_linear_model
from diffdrive_mpc.models.output_error.validation import fit_percent
from diffdrive_mpc.models.robot import load_robot
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.plants.surface import load_surface
from diffdrive_mpc.sim.plants.twin_parameters import FIRMWARE_FILE, Firmware, load_firmware
from diffdrive_mpc.sim.sensing.sensor_set import load_sensor_set
from studies.open_loop import OpenLoopDrive, drive_open_loop, random_commands

_SIGNIFICANT_DIGITS = 4


class Bounds(StrictModel):
    """Lower and upper bounds of the calibrated parameters; units as in `Firmware`."""

    gain_v: tuple[float, float]
    lag_v: tuple[float, float]
    lag_omega: tuple[float, float]
    track: tuple[float, float]


class RequiredFit(StrictModel):
    """Minimum FIT of validation drives [%]."""

    v: float
    omega: float


class CalibrationParameters(StrictModel):
    """Settings of the calibration; `calibration.yaml` describes each setting."""

    target: str
    seeds: list[int]
    held_out_seeds: list[int]
    bounds: Bounds
    neighbour: Annotated[float, Field(gt=0, lt=1)]
    required_fit: RequiredFit


class PredictionFit(NamedTuple):
    """FIT of the target model on one drive; `smooth` is True for smoothed commands, False for stepwise commands."""

    seed: int
    smooth: bool
    v: float
    """FIT of the forward speed [%]."""
    omega: float
    """FIT of the gyro's yaw rate [%]."""


@cache
def load_calibration_parameters() -> CalibrationParameters:
    """Read `calibration.yaml`; raise ConfigError if it is invalid."""
    return load_checked(CalibrationParameters, Path(__file__).with_name("calibration.yaml"))


def validate_calibration(firmware: Firmware | None = None, seeds: list[int] | None = None) -> list[PredictionFit]:
    """Compute the FIT of the target model on random drives of the plant, with smoothed and with stepwise commands.

    Parameters
    ----------
    firmware
        Firmware parameters; by default the shipped parameters.
    seeds
        Seeds of the drives; by default the seeds of the validation drives.
    """
    parameters = load_calibration_parameters()
    firmware = firmware or load_firmware()
    target = _target_model()
    fits = []
    for seed in seeds or parameters.held_out_seeds:
        for smooth in (True, False):
            drive = _drive(firmware, seed, smooth)
            fit = [
                fit_percent(y, yhat) for y, yhat in zip(drive.output.T, target.simulate(drive.command).T, strict=True)
            ]
            fits.append(PredictionFit(seed, smooth, *fit))
    return fits


def neighbour_errors(firmware: Firmware | None = None) -> dict[str, tuple[float, ...]]:
    """Compute the error of the target model for neighbouring values of each parameter, relative to `firmware` [-].

    If all ratios exceed one, no neighbouring value fits the calibration drives better. A parameter at its bound has
    one neighbour. `firmware` defaults to the shipped parameters.
    """
    parameters = load_calibration_parameters()
    firmware = firmware or load_firmware()
    calibrated_error, errors = _cost(firmware), {}
    for name in Bounds.model_fields:
        low, high = getattr(parameters.bounds, name)
        value, step = getattr(firmware, name), parameters.neighbour * (high - low)
        neighbours = [candidate for candidate in (value - step, value + step) if low <= candidate <= high]
        errors[name] = tuple(
            _cost(firmware.model_copy(update={name: candidate})) / calibrated_error for candidate in neighbours
        )
    return errors


def calibrate(
    path: str | Path = FIRMWARE_FILE,
    date: datetime.date | None = None,
    on_evaluation: Callable[[], None] | None = None,
) -> Firmware:
    """Fit the firmware parameters to the calibration drives and write them with provenance to `path`.

    Parameters
    ----------
    path
        Parameter file to write; by default the shipped file.
    date
        Date for the provenance; today by default.
    on_evaluation
        Function that is called after each evaluation of a set of parameters.

    Raises
    ------
    models.checked_yaml.ConfigError
        If `path` cannot be written, which is checked before the fit. After any error, `path` is unchanged.
    """
    with whole_file(path, rewrites=True) as unfinished:
        firmware = _fit_firmware(date or datetime.date.today(), on_evaluation)
        write_firmware(firmware, unfinished)
    return firmware


def _fit_firmware(date: datetime.date, on_evaluation: Callable[[], None] | None) -> Firmware:
    from scipy.optimize import minimize  # noqa: PLC0415 - loads slowly

    parameters = load_calibration_parameters()
    names = list(Bounds.model_fields)
    low, high = np.transpose([getattr(parameters.bounds, name) for name in names])

    def cost(scaled: FloatArray) -> float:
        error = _cost(_build_firmware(names, low + scaled * (high - low), {}))
        if on_evaluation is not None:
            on_evaluation()
        return error

    # Quantisation of the sensors makes the cost rough on a small scale: gradients are meaningless, and a wide initial
    # simplex averages over the roughness.
    simplex = np.full((len(names) + 1, len(names)), 0.3) + 0.3 * np.eye(len(names) + 1, len(names), k=-1)
    options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 1e-5}
    solution = minimize(cost, simplex[0], method="Nelder-Mead", bounds=[(0, 1)] * len(names), options=options)
    values = low + solution.x * (high - low)
    firmware = _build_firmware(names, values, {})
    held_out = validate_calibration(firmware)
    provenance: dict[str, object] = {
        "target": parameters.target,
        "method": "Nelder-Mead on the squared free-run error of the target, v of the encoders and omega of the gyro",
        "plant": "mujoco, surface default, sensors default",
        "drives": "random commands, smoothed, 30 s",
        "seeds": parameters.seeds,
        "date": date.isoformat(),
        "held_out_fit_percent": [
            {"seed": fit.seed, "smooth": fit.smooth, "v": round(fit.v, 2), "omega": round(fit.omega, 2)}
            for fit in held_out
        ],
    }
    return _build_firmware(names, values, provenance)


def _drive(firmware: Firmware, seed: int, smooth: bool) -> OpenLoopDrive:
    from diffdrive_mpc.sim.plants.mujoco_plant import MujocoPlant  # noqa: PLC0415 - needs MuJoCo

    friction = load_surface("default").friction
    if friction is None:
        raise ConfigError("surface 'default' has no friction; the calibration drives require it")
    return drive_open_loop(
        MujocoPlant(friction, load_sensor_set("default"), seed, firmware=firmware), random_commands(seed, smooth)
    )


@cache
def _target_model() -> DiscreteModel:
    return load_linear_model(load_calibration_parameters().target).discretise(load_robot().sample_time)


def _cost(firmware: Firmware) -> float:
    """Compute the error energy of the target model on the calibration drives."""
    parameters = load_calibration_parameters()
    target = _target_model()
    return sum(_squared_error(_drive(firmware, seed, smooth=True), target) for seed in parameters.seeds)


def _squared_error(drive: OpenLoopDrive, target: DiscreteModel) -> float:
    """Compute the error energy of the target model relative to the predicted energy, summed over v and omega."""
    predicted = target.simulate(drive.command)
    energy = np.sum((predicted - predicted.mean(axis=0)) ** 2, axis=0)
    return float(np.sum(np.sum((drive.output - predicted) ** 2, axis=0) / energy))


def _build_firmware(names: list[str], values: FloatArray, provenance: dict[str, object]) -> Firmware:
    parameters = {name: float(f"{value:.{_SIGNIFICANT_DIGITS}g}") for name, value in zip(names, values, strict=True)}
    return Firmware(**parameters, provenance=provenance)


_HEADER = """\
# Firmware of the digital twin, written by studies.shipped_models.calibration.calibrate(). SI units.
# Adjusted: lag of each command channel, forward gain, and the track that turns yaw rate into wheel speeds.
# Remaining differences: the plant has a dead time of 40 ms and the target has none, so steps fit less well than smooth
# drives; the target couples v_ref into omega, whereas the plant is almost symmetric; yaw gain and side-slip of the
# plant depend on speed, friction and turn radius, whereas the target is linear.
"""


def write_firmware(firmware: Firmware, path: str | Path) -> None:
    """Write a file of firmware parameters, with a comment on the fit and the remaining differences to the target."""
    text = yaml.safe_dump(firmware.model_dump(), sort_keys=False, default_flow_style=None, width=120)
    Path(path).write_text(_HEADER + text, encoding="utf-8")


# Tables of the prediction of the simulated robot by the published model.


def calibration_table(firmware: Firmware) -> Table:
    """Tabulate the FIT of the target model, simulated from commands, on validation drives."""
    fits = validate_calibration(firmware)
    rows = [
        (str(fit.seed), "smoothed" if fit.smooth else "stepwise", f"{fit.v:.2f}", f"{fit.omega:.2f}")
        for fit in sorted(fits, key=lambda fit: not fit.smooth)
    ]
    title = "The published SSM against the simulated robot on validation drives"
    return Table(title, ("seed", "set-points", "FIT v [%]", "FIT omega [%]"), tuple(rows), text_columns=2)


def neighbours_table(errors: Mapping[str, Sequence[float]]) -> Table:
    """Tabulate the results of `neighbour_errors`."""
    rows = [(name, *(f"{ratio:.3f}" for ratio in ratios)) for name, ratios in errors.items()]
    title = "Error on the calibration drives with one parameter changed, relative to the calibrated parameters [-]"
    columns = ("parameter", "lower value", "higher value")
    return Table(title, columns, tuple((*row, "at its bound")[:3] for row in rows), text_columns=1)
