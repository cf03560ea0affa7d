"""Selection of base effects that improve the prediction of held-out blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.identification.effects.fitting import EffectFit, Weighted, fit_effects, weight_readings
from diffdrive_mpc.models.identification.effects.free_run import SENSORS, Point, base_track
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import SampledExperiment
from diffdrive_mpc.models.output_error.held_out import blocks
from diffdrive_mpc.models.velocity_model import CHANNELS

LINEAR = (
    "gain.v",
    "gain.omega",
    "lag.v",
    "lag.omega",
    "dead_time.v",
    "dead_time.omega",
    "encoders.delay",
    "encoders.yaw_ratio",
    "gyro.offset",
)
BY_ENCODERS = LINEAR[:6]
"""Parameters in `LINEAR` that are determined without a gyro."""
_CLIPPED = "clipped commands"
EFFECTS: Mapping[str, tuple[str, ...]] = {
    _CLIPPED: ("limit.v", "limit.omega"),
    "different poles of v": ("damping.v",),
    "different poles of omega": ("damping.omega",),
    "twist slew": ("slew.v", "slew.omega"),
    "lag of the encoders": ("encoders.lag",),
    "top speed of the wheels": ("wheels.top_speed",),
    "steps and coasting of the wheels": ("wheels.resolution", "wheels.coasting"),
    "yaw relaxation": ("relaxation",),
    "veer": ("veer",),
}
"""Parameters by effect, in the order of the trials."""
_NEEDS_TRACK = ("steps and coasting of the wheels",)
_TRACK = "encoders.track"
_BY_GYRO = ("lag of the encoders", "yaw relaxation", "veer")
_WITHOUT_GYRO = {"encoders.delay": 0.0, "encoders.yaw_ratio": 1.0, "gyro.offset": 0.0}
_ROUNDS = 2
_BOUND_TOLERANCE = 3e-3
"""Distance from a bound, as a share of the range, within which a parameter counts as at the bound."""
_MIN_TIME_CONSTANT = 2e-3
"""Minimum time constant that a fit can determine [s]."""


@dataclass(frozen=True)
class FoldFits:
    """Fit of a model to all data, and fits of this model without one held-out block each.

    Attributes
    ----------
    fit
        Fit to all data.
    points
        Parameters of the fits without one block, by block.
    """

    fit: EffectFit
    points: tuple[Point, ...]


def fit_folds(fit: EffectFit, data: Weighted) -> FoldFits:
    """Repeat the fit without each block in turn, with the parameters of `fit` as initial values."""
    trial = effect_settings().trial_evaluations
    folds = blocks(data.experiments)
    fits = [fit_effects(fit.point, fit.free, data.part(rest), trial, near=True) for rest, _ in folds]
    return FoldFits(fit, tuple(fold.point for fold in fits))


class BlockComparison(NamedTuple):
    """Comparison of two models on held-out blocks."""

    gain: float
    """Decrease of the logarithm of the error power, averaged over the sensors [-]."""
    error: float
    """Standard error of the gain, from the scatter between blocks [-]."""
    blocks: int
    """Number of blocks with a decrease."""


def gain(old: FoldFits, new: FoldFits, data: Weighted) -> BlockComparison:
    """Compare the models `old` and `new` on the held-out blocks."""
    powers = np.array([_powers(model, data) for model in (old, new)])
    improvements = -np.diff(np.log(powers).mean(axis=2), axis=0)[0]
    total = np.log(powers.sum(axis=1)).mean(axis=1)
    error = float(improvements.std(ddof=1) / np.sqrt(len(improvements)))
    return BlockComparison(float(total[0] - total[1]), error, int(np.sum(improvements > 0)))


def _powers(model: FoldFits, data: Weighted) -> FloatArray:
    """Sum the squared weighted errors (blocks, p) of each sensor in each block, for the fit without this block."""
    parts = [data.part(block) for _, block in blocks(data.experiments)]
    return np.array(
        [
            np.sum([np.nansum(error**2, axis=0) for error in part.errors(point)], axis=0)
            for part, point in zip(parts, model.points, strict=True)
        ]
    )


@dataclass(frozen=True)
class EffectTrial:
    """Trial of one effect.

    Attributes
    ----------
    effect
        Name of the effect.
    gain
        Decrease of the logarithm of the held-out error power by the effect, averaged over the sensors [-].
    blocks
        Number of blocks with a better prediction.
    selected
        True if the effect is part of the model after the trial.
    again
        True for the second trial of a selected effect, with all other selected effects in the model.
    """

    effect: str
    gain: float
    blocks: int
    selected: bool
    again: bool


@dataclass(frozen=True)
class Selection:
    """Model with the selected effects, and all trials.

    Attributes
    ----------
    fit
        Fit of the model with the selected effects to all records.
    effects
        Names of the selected effects.
    trials
        Trials of effects, in order.
    data
        Readings with their final weights.
    points
        Parameters of the fits without one block of the records, by block.
    """

    fit: EffectFit
    effects: tuple[str, ...]
    trials: tuple[EffectTrial, ...]
    data: Weighted
    points: tuple[Point, ...]


def select_effects(
    experiments: Sequence[SampledExperiment],
    encoder_track: float | None,
    on_trial: Callable[[str], None] | None = None,
    limits: Mapping[str, float] | None = None,
    names: Sequence[str] | None = None,
    extra: Sequence[str] = (),
) -> Selection:
    """Fit the linear model with its sensors, then test every effect.

    Effects are added in the order of `EFFECTS`. Each selected effect is then tested by its removal, because a later
    effect may explain the data of an earlier effect better.

    Parameters
    ----------
    experiments
        Commands and readings, with or without a gyro; see `sensor_experiments`. Without a gyro, no effect between
        wheels and body is tested, and omega is that of the encoders.
    encoder_track
        Track for the computation of the encoders' yaw rate [m]; None if unknown. An unknown track is identified
        together with a top speed of the wheels, and steps of the wheels are not tested.
    on_trial
        Function that is called with the name of the next trial.
    limits
        Limits of channels at which a simpler model clips the command.
    names
        Names of the effects to test; None for all.
    extra
        Names of free parameters in addition to `LINEAR`.

    Raises
    ------
    ValueError
        If a reading never changes, or the records are too short for held-out blocks.
    """
    settings = effect_settings()
    has_gyro = experiments[0].outputs.shape[1] == len(SENSORS)
    free = (*(LINEAR if has_gyro else BY_ENCODERS), *extra)
    start = {name: settings.parameters[name][2] for name in (*LINEAR, *extra)} | ({} if has_gyro else _WITHOUT_GYRO)
    if encoder_track is not None:
        start[_TRACK] = encoder_track
    clipping = {f"limit.{channel}": level for channel, level in (limits or {}).items()}
    data = weight_readings(experiments)
    for _ in range(_ROUNDS):
        fit = fit_effects(start, free, data)
        start, data = dict(fit.point), weight_readings(experiments, fit.point)
    model = fit_folds(fit, data)
    effects: list[str] = []
    trials: list[EffectTrial] = []
    announce = on_trial or (lambda _: None)
    candidates = _identifiable(has_gyro=has_gyro, has_track=encoder_track is not None, is_clipped=bool(clipping))
    for effect in [name for name in candidates if names is None or name in names]:
        announce(effect)
        candidate = fit_folds(_fit_with(model.fit, effect, data, clipping if effect == _CLIPPED else {}), data)
        score = gain(model, candidate, data)
        significant = score.gain > settings.significance * score.error
        selected = significant and score.gain > settings.min_gain and 2 * score.blocks > len(model.points)
        trials.append(EffectTrial(effect, score.gain, score.blocks, selected, again=False))
        if selected:
            effects.append(effect)
            model, data = candidate, weight_readings(experiments, candidate.fit.point)
    for effect in tuple(effects):
        announce(f"without {effect}")
        candidate = fit_folds(_fit_without(model.fit, effect, data), data)
        score = gain(candidate, model, data)
        selected = score.gain > settings.min_gain
        trials.append(EffectTrial(effect, score.gain, score.blocks, selected, again=True))
        if not selected:
            effects.remove(effect)
            model, data = candidate, weight_readings(experiments, candidate.fit.point)
    return Selection(_fit_to_convergence(model.fit, data), tuple(effects), tuple(trials), data, model.points)


def _identifiable(*, has_gyro: bool, has_track: bool, is_clipped: bool) -> list[str]:
    """List the identifiable effects; `is_clipped` is True if the plain model clips commands."""
    clipping = () if is_clipped else (_CLIPPED,)
    excluded = {*(() if has_gyro else _BY_GYRO), *(() if has_track else _NEEDS_TRACK), *clipping}
    return [effect for effect in EFFECTS if effect not in excluded]


def _fit_with(fit: EffectFit, effect: str, data: Weighted, initial_limits: Point) -> EffectFit:
    """Fit the model with an additional effect; `initial_limits` replaces the initial values of the settings."""
    settings = effect_settings()
    guess = {name: settings.parameters[name][2] for name in EFFECTS[effect] if name in settings.parameters}
    guess = dict(initial_limits) or guess
    if "wheels.top_speed" in guess and _TRACK not in fit.point:
        return _fit_with_track(fit, data)
    if "wheels.top_speed" in guess:
        # Start slightly below the maximum command, because the cost has no slope for an inactive limit.
        guess["wheels.top_speed"] = 0.9 * max(float(np.abs(e.inputs[:, 0]).max()) for e in data.experiments)
    free = (*fit.free, *guess)
    start = {**fit.point, **guess}
    if "wheels.resolution" not in EFFECTS[effect]:
        return fit_effects(start, free, data)

    def with_step(step: float) -> EffectFit:
        return fit_effects({**start, "wheels.resolution": step}, free, data, settings.trial_evaluations)

    best = min(map(with_step, settings.resolutions), key=_cost)
    coarse_step = best.point["wheels.resolution"]
    # Start from the best fit so far, because the fits of the coarse search may not have converged.
    for factor in settings.resolution_factors:
        start = dict(best.point)
        best = min(best, with_step(factor * coarse_step), key=_cost)
    return fit_effects(best.point, free, data, near=True)


def _fit_with_track(fit: EffectFit, data: Weighted) -> EffectFit:
    """Fit a top speed of the wheels and an unknown track, which the shape of the clipped commands determines."""
    settings = effect_settings()
    commands = np.concatenate([np.abs(experiment.inputs) for experiment in data.experiments])
    scale = 2.0 * commands[:, 0].max() / commands[:, 1].max()
    low, high, _ = settings.parameters[_TRACK]

    def fit_from(share: float) -> EffectFit:
        half = 0.5 * share * scale
        max_speed = float((commands[:, 0] + half * commands[:, 1]).max())
        unit = base_track({**fit.point, _TRACK: 1.0})
        guess = {"wheels.top_speed": 0.9 * max_speed, _TRACK: float(np.clip(2.0 * half / unit, low, high))}
        return fit_effects({**fit.point, **guess}, (*fit.free, *guess), data, settings.trial_evaluations)

    best = min(map(fit_from, settings.wheel_bases), key=_cost)
    return fit_effects(best.point, best.free, data, near=True)


def _fit_without(fit: EffectFit, effect: str, data: Weighted) -> EffectFit:
    removed = EFFECTS[effect]
    if "wheels.top_speed" in removed and _TRACK in fit.free:
        removed = (*removed, _TRACK)
    point: Point = {name: value for name, value in fit.point.items() if name not in removed}
    return fit_effects(point, [name for name in fit.free if name not in removed], data)


def _fit_to_convergence(fit: EffectFit, data: Weighted) -> EffectFit:
    """Fit to convergence, with parameters at a bound fixed at this bound.

    A pole that is too fast for an estimate is fixed at the minimum time constant.
    """
    point = dict(fit.point)
    fixed = []
    for channel in CHANNELS:
        lag, damping = point[f"lag.{channel}"], max(point.get(f"damping.{channel}", 1.0), 1.0)
        slow = lag * (damping + np.sqrt(damping**2 - 1.0))
        if lag**2 / slow < _MIN_TIME_CONSTANT < slow:
            lag = np.sqrt(slow * _MIN_TIME_CONSTANT)
            point |= {f"lag.{channel}": lag, f"damping.{channel}": 0.5 * (slow + _MIN_TIME_CONSTANT) / lag}
            fixed.append(f"damping.{channel}")
    # With a fixed fast pole, the lag determines the slow pole, so it is not fixed at its bound.
    for name in [name for name in fit.free if name.replace("lag.", "damping.") not in fixed]:
        low, high, _ = effect_settings().parameters[name]
        for bound in (low, high):
            if abs(point[name] - bound) < _BOUND_TOLERANCE * (high - low):
                point[name] = bound
    bounds = effect_settings().parameters
    free = [name for name in fit.free if name not in fixed and point[name] not in bounds[name][:2]]
    return fit_effects(point, free, data, near=True)


def _cost(fit: EffectFit) -> float:
    return fit.cost
