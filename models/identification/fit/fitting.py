"""Conversion of records to a model, for every structure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.doubt import Doubt
from diffdrive_mpc.models.identification.effects import IdentifiedBase, identify_with_effects
from diffdrive_mpc.models.identification.effects.free_run import free_run, sensor_experiments
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.identification.fit.predictor import Finder, Predictor
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.logs.geometry import WheelGeometry, wheel_geometry
from diffdrive_mpc.models.output_error.experiment import YawSource, joined, twist_experiments
from diffdrive_mpc.models.output_error.held_out import blocks, cut, hold_out
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.output_error.validation import Validation, score, simulate_records
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.orders import OrderChoice
from diffdrive_mpc.models.structures.structure import IdentificationConditions, Structure, StructureFit
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True)
class Fitted:
    """A model, and how well a free simulation of it explains the records.

    Attributes
    ----------
    identified
        The model.
    orders
        The orders compared; None for structures that have no choice.
    base
        The same model with the effects of its base; None where that was not requested.
    geometry
        Wheel radius and track of the log; None without wheel speeds.
    train, validation
        FIT, RMSE and residuals on either set.
    simulated
        For each validation record (K, 2) v [m/s] and omega [rad/s], sensor offsets included.
    seconds
        Duration of the estimation [s], without reading, validation and figures.
    predictor
        Model that predicts in place of `identified`, which limits and tracks still come from; None where `identified`
        predicts.
    """

    identified: IdentifiedModel
    orders: OrderChoice | None
    base: IdentifiedBase | None
    geometry: WheelGeometry | None
    train: Validation
    validation: Validation
    simulated: tuple[FloatArray, ...]
    seconds: float
    predictor: Predictor | None = None

    @property
    def structure(self) -> str:
        """Name of the structure that predicts."""
        return self.identified.structure if self.predictor is None else self.predictor.structure

    @property
    def method(self) -> str:
        """Method in words."""
        return self.identified.method if self.predictor is None else self.predictor.method

    @property
    def offset(self) -> FloatArray:
        """(2,) readings of v [m/s] and omega [rad/s] at rest: bias of the sensors, as the model has it."""
        return self.identified.offset if self.predictor is None else self.predictor.offset

    @property
    def states(self) -> int:
        """Number of states of the prediction model."""
        return self.identified.model.order if self.predictor is None else self.predictor.states


def fit(
    data: LogData,
    structure: Structure,
    order: int | None = None,
    *,
    effects: bool = False,
    on_trial: Callable[[str], None] | None = None,
) -> Fitted:
    """Identify a model and try it on the records held out.

    Parameters
    ----------
    data
        The records.
    structure
        Structure of the model.
    order
        Order of the model, where the structure has a choice; None to choose it.
    effects
        Whether to identify the effects of the base around the model, where the structure allows it.
    on_trial
        Called with the name of each effect that is tried.

    Raises
    ------
    ValueError
        If the records do not allow it; ModelError, a kind of it, if the numbers found cannot be a robot's.
    """
    geometry = wheel_geometry(data.train)
    base: IdentifiedBase | None = None
    started = perf_counter()
    radius = geometry.radius if geometry else None
    identification = structure.identify(data.train, IdentificationConditions(data.validation, data.yaw, order, radius))
    if effects:
        identification, base = _with_effects(data, identification, geometry, on_trial)
    seconds = perf_counter() - started
    identified = identification.identified
    _ = identified.model  # refuses what cannot be a robot
    simulated = [_simulated(identified, base, records) for records in (data.train, data.validation)]
    scores = scored(simulated, data, identified.yaw)
    return Fitted(identified, identification.orders, base, geometry, *scores, tuple(simulated[1]), seconds)


def _with_effects(
    data: LogData, plain: StructureFit, geometry: WheelGeometry | None, on_trial: Callable[[str], None] | None
) -> tuple[StructureFit, IdentifiedBase | None]:
    """Fit the model with effects; return the plain one with a warning if it predicts held-out blocks as well."""
    track = geometry.track if geometry else None
    limits = plain.identified.limits
    try:
        base = identify_with_effects(data.train, yaw=data.yaw, encoder_track=track, limits=limits, on_trial=on_trial)
        _ = base.identified.model  # refuses what cannot be a robot
        words = loses(base, plain.identified, data.train)
    except ValueError as error:
        words = f"effects were not looked for: {error}"
    else:
        if words is None:
            return StructureFit(base.identified), base
    warned = replace(plain.identified, warnings=(*plain.identified.warnings, Doubt("effects left out", words)))
    return StructureFit(warned, plain.orders), None


def _simulated(identified: IdentifiedModel, base: IdentifiedBase | None, records: Sequence[Record]) -> list[FloatArray]:
    """Simulate speed of the encoders and omega as the model defines it, in one free run over each record."""
    if base is None:
        return simulate_records(identified.system, records, identified.yaw)
    return [readings[:, [0, -1]] for readings in base.readings(records)]


def scored(simulated: Sequence[Sequence[FloatArray]], data: LogData, yaw: YawSource) -> tuple[Validation, Validation]:
    """Score outputs (K, 2) on the training records and on those held out; raise ConfigError if that is impossible.

    `simulated` has one sequence for each of both, with one array for each record.
    """
    scores = []
    for outputs, records, name in zip(
        simulated, (data.train, data.validation), ("training", "validation"), strict=True
    ):
        try:
            scores.append(score(outputs, twist_experiments(records, yaw)))
        except ValueError as error:
            raise ConfigError(f"{name} records: {error}") from error
    return scores[0], scores[1]


def loses(base: IdentifiedBase, plain: IdentifiedModel, records: Sequence[Record]) -> str | None:
    """Explain that `base` predicts held-out blocks worse than `plain`, an SM from `records`; else None.

    Raises
    ------
    ValueError
        If the records are too short to hold blocks out.
    """
    experiments, settings = joined(twist_experiments(records, plain.yaw)), effect_settings()
    measured = joined(sensor_experiments(records, plain.yaw))
    powers: list[FloatArray] = []
    for row in range(2):
        channel = [experiment.channel(row, row) for experiment in experiments]
        powers.append(hold_out(plain.fits[row], channel).powers[:, 0])
    with_effects = []
    for (_, block), point in zip(blocks(measured), base.points, strict=True):
        errors = [(free_run(point, part) - part.readings)[:, [0, -1]] for part in cut(measured, block)]
        with_effects.append(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    rms = np.sqrt([np.mean(powers, axis=1), np.mean(with_effects, axis=0)])
    fits = 100.0 * (1.0 - rms / output_spread(experiments))
    gained = fits[1] - fits[0]
    if gained.min() > -settings.most_lost and gained.mean() > 0.0:
        return None
    shown = ", ".join(f"{name} {a:.1f} to {b:.1f} %" for name, a, b in zip(CHANNELS, *fits, strict=True))
    effects = ", ".join(base.effects) or "a delay of the encoders"
    return f"effects ({effects}) predict held-out blocks no better than the plain model, FIT {shown}: left out"


def with_predictor(data: LogData, fitted: Fitted, find: Finder) -> Fitted:
    """Fit a predictor to the training records; return `fitted` with it and its scores and outputs.

    Raises
    ------
    models.errors.MissingPackageError
        If the package of the predictor is not installed.
    ValueError
        If the records are too few.
    """
    started = perf_counter()
    predictor = find(data, fitted)
    seconds = perf_counter() - started
    yaw = fitted.identified.yaw
    simulated = [predictor.simulate(records, yaw) for records in (data.train, data.validation)]
    train, validation = scored(simulated, data, yaw)
    return replace(
        fitted,
        predictor=predictor,
        train=train,
        validation=validation,
        simulated=tuple(simulated[1]),
        seconds=fitted.seconds + seconds,
    )
