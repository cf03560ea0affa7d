"""Fit of a model of any structure to records."""

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
from diffdrive_mpc.models.output_error.experiment import YawSource, join_experiments, twist_experiments
from diffdrive_mpc.models.output_error.held_out import blocks, extract, hold_out
from diffdrive_mpc.models.output_error.statistics import output_spread
from diffdrive_mpc.models.output_error.validation import Validation, score, simulate_records
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.structures.orders import OrderChoice
from diffdrive_mpc.models.structures.structure import IdentificationConditions, Structure, StructureFit
from diffdrive_mpc.models.velocity_model import CHANNELS


@dataclass(frozen=True)
class Fitted:
    """Identified model, with scores of its free simulation on the records.

    Attributes
    ----------
    identified
        Identified linear model.
    orders
        Comparison of orders; None for structures with a fixed order.
    base
        Model with base effects; None if it was not requested or predicts no better.
    geometry
        Wheel radius and track from the log; None if the log has no wheel speeds.
    train, validation
        FIT, RMSE and residuals on training and validation records.
    simulated
        Simulated v [m/s] and omega [rad/s] (K, 2) of each validation record, including sensor offsets.
    seconds
        Duration of the estimation [s], without reading, validation and figures.
    predictor
        Model that predicts instead of `identified`, which then determines limits and tracks only; None if `identified`
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
        """Name of the structure of the predicting model."""
        return self.identified.structure if self.predictor is None else self.predictor.structure

    @property
    def method(self) -> str:
        """Description of the identification method."""
        return self.identified.method if self.predictor is None else self.predictor.method

    @property
    def offset(self) -> FloatArray:
        """Sensor bias (2,) of the model: readings of v [m/s] and omega [rad/s] at rest."""
        return self.identified.offset if self.predictor is None else self.predictor.offset

    @property
    def states(self) -> int:
        """Number of states of the predicting model."""
        return self.identified.model.order if self.predictor is None else self.predictor.states


def fit(
    data: LogData,
    structure: Structure,
    order: int | None = None,
    *,
    effects: bool = False,
    on_trial: Callable[[str], None] | None = None,
) -> Fitted:
    """Identify a model and score it on the validation records.

    Parameters
    ----------
    data
        Training and validation records.
    structure
        Structure of the model.
    order
        Order of the model, for structures without a fixed order; None to select it.
    effects
        True to identify base effects, for structures that support them.
    on_trial
        Function that is called with the name of each effect before its trial.

    Raises
    ------
    ValueError
        If the records are unsuitable; its subclass ModelError if the estimated parameters cannot describe a robot.
    """
    geometry = wheel_geometry(data.train)
    base: IdentifiedBase | None = None
    start = perf_counter()
    radius = geometry.radius if geometry else None
    identification = structure.identify(data.train, IdentificationConditions(data.validation, data.yaw, order, radius))
    if effects:
        identification, base = _with_effects(data, identification, geometry, on_trial)
    seconds = perf_counter() - start
    identified = identification.identified
    _ = identified.model  # raises ModelError for parameters that cannot describe a robot
    simulated = [_simulate(identified, base, records) for records in (data.train, data.validation)]
    scores = score_sets(simulated, data, identified.yaw)
    return Fitted(identified, identification.orders, base, geometry, *scores, tuple(simulated[1]), seconds)


def _with_effects(
    data: LogData, plain: StructureFit, geometry: WheelGeometry | None, on_trial: Callable[[str], None] | None
) -> tuple[StructureFit, IdentifiedBase | None]:
    """Fit the model with base effects; if the plain model predicts as well, return it with a warning."""
    track = geometry.track if geometry else None
    limits = plain.identified.limits
    try:
        base = identify_with_effects(data.train, yaw=data.yaw, encoder_track=track, limits=limits, on_trial=on_trial)
        _ = base.identified.model  # raises ModelError for parameters that cannot describe a robot
        reason = explain_rejection(base, plain.identified, data.train)
    except ValueError as error:
        reason = f"effects were not estimated: {error}"
    else:
        if reason is None:
            return StructureFit(base.identified), base
    warnings = (*plain.identified.warnings, Doubt("effects left out", reason))
    return StructureFit(replace(plain.identified, warnings=warnings), plain.orders), None


def _simulate(identified: IdentifiedModel, base: IdentifiedBase | None, records: Sequence[Record]) -> list[FloatArray]:
    """Simulate v and omega (K, 2), as measured by the model's sensors, in one free run over each record."""
    if base is None:
        return simulate_records(identified.system, records, identified.yaw)
    return [readings[:, [0, -1]] for readings in base.readings(records)]


def score_sets(
    simulated: Sequence[Sequence[FloatArray]], data: LogData, yaw: YawSource
) -> tuple[Validation, Validation]:
    """Score simulated outputs (K, 2) on training and validation records.

    `simulated` contains one sequence for each of the two sets, with one array for each record.

    Raises
    ------
    ConfigError
        If the records cannot be scored.
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


def explain_rejection(base: IdentifiedBase, plain: IdentifiedModel, records: Sequence[Record]) -> str | None:
    """Explain why `base` is rejected: it predicts held-out blocks no better than `plain`; None if it predicts better.

    `plain` is an SM identified from `records`.

    Raises
    ------
    ValueError
        If the records are too short for held-out blocks.
    """
    experiments, settings = join_experiments(twist_experiments(records, plain.yaw)), effect_settings()
    measured = join_experiments(sensor_experiments(records, plain.yaw))
    powers: list[FloatArray] = []
    for row in range(2):
        channel = [experiment.channel(row, row) for experiment in experiments]
        powers.append(hold_out(plain.fits[row], channel).powers[:, 0])
    effect_powers = []
    for (_, block), point in zip(blocks(measured), base.points, strict=True):
        errors = [(free_run(point, part) - part.readings)[:, [0, -1]] for part in extract(measured, block)]
        effect_powers.append(np.nanmean(np.concatenate(errors) ** 2, axis=0))
    rms = np.sqrt([np.mean(powers, axis=1), np.mean(effect_powers, axis=0)])
    fits = 100.0 * (1.0 - rms / output_spread(experiments))
    gain = fits[1] - fits[0]
    if gain.min() > -settings.max_fit_loss and gain.mean() > 0.0:
        return None
    changes = ", ".join(f"{name} {a:.1f} to {b:.1f} %" for name, a, b in zip(CHANNELS, *fits, strict=True))
    effects = ", ".join(base.effects) or "a delay of the encoders"
    return f"effects ({effects}) predict held-out blocks no better than the plain model (FIT {changes}); not used"


def with_predictor(data: LogData, fitted: Fitted, find: Finder) -> Fitted:
    """Fit a predictor to the training records; return a copy of `fitted` with predictor, scores and outputs.

    Raises
    ------
    models.errors.MissingPackageError
        If the package of the predictor is not installed.
    ValueError
        If the records are too few.
    """
    start = perf_counter()
    predictor = find(data, fitted)
    seconds = perf_counter() - start
    yaw = fitted.identified.yaw
    simulated = [predictor.simulate(records, yaw) for records in (data.train, data.validation)]
    train, validation = score_sets(simulated, data, yaw)
    return replace(
        fitted,
        predictor=predictor,
        train=train,
        validation=validation,
        simulated=tuple(simulated[1]),
        seconds=fitted.seconds + seconds,
    )
