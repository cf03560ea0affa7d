"""Selection of base effects: an effect is selected only if it improves the prediction of held-out blocks."""

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
"""Parameters of `LINEAR` that encoders alone determine."""
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
"""Parameters of each effect, in the order in which they are tried."""
_NEEDS_TRACK = ("steps and coasting of the wheels",)
_TRACK = "encoders.track"
_BY_GYRO = ("lag of the encoders", "yaw relaxation", "veer")
_WITHOUT_GYRO = {"encoders.delay": 0.0, "encoders.yaw_ratio": 1.0, "gyro.offset": 0.0}
_ROUNDS = 2
_AT_BOUND = 3e-3
"""Distance from a bound, as a share of the range, within which a parameter counts as at the bound."""
_FASTEST = 2e-3
"""Minimum time constant that a fit can determine [s]."""


@dataclass(frozen=True)
class FoldFits:
    """A fit to all data, and one fit of the same model for each held-out block.

    Attributes
    ----------
    fit
        Fit to all data.
    points
        Parameters fitted without each block.
    """

    fit: EffectFit
    points: tuple[Point, ...]


def fit_folds(fit: EffectFit, data: Weighted) -> FoldFits:
    """Repeat the search without each block in turn, starting at `fit`."""
    trial = effect_settings().trial
    folds = blocks(data.experiments)
    fits = [fit_effects(fit.point, fit.free, data.part(rest), trial, near=True) for rest, _ in folds]
    return FoldFits(fit, tuple(fold.point for fold in fits))


class Worth(NamedTuple):
    """Advantage of one model over another on held-out blocks."""

    gain: float
    """Decrease of the logarithm of the error power, mean over sensors."""
    error: float
    """Standard error of the gain, from the scatter between blocks."""
    blocks: int
    """Number of blocks with a decrease."""


def gain(old: FoldFits, new: FoldFits, data: Weighted) -> Worth:
    """Compare two models on the held-out blocks."""
    powers = np.array([_powers(model, data) for model in (old, new)])
    falls = -np.diff(np.log(powers).mean(axis=2), axis=0)[0]
    whole = np.log(powers.sum(axis=1)).mean(axis=1)
    error = float(falls.std(ddof=1) / np.sqrt(len(falls)))
    return Worth(float(whole[0] - whole[1]), error, int(np.sum(falls > 0)))


def _powers(model: FoldFits, data: Weighted) -> FloatArray:
    """Sum the squared weighted errors of each sensor in each block (blocks, p), by the model fitted without it."""
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
        Decrease of the logarithm of the held-out error power by the effect, mean over the sensors.
    blocks
        Number of blocks with a better prediction.
    selected
        True if the effect belongs to the model after the trial.
    again
        True for a second trial of a selected effect, together with all others.
    """

    effect: str
    gain: float
    blocks: int
    selected: bool
    again: bool


@dataclass(frozen=True)
class Selection:
    """Result of the selection.

    Attributes
    ----------
    fit
        Estimate from all records, with the selected effects.
    effects
        Names of the selected effects.
    trials
        Trials of effects, in order.
    data
        Readings with their final weights.
    points
        Parameters fitted without each block of the records.
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
    only: Sequence[str] | None = None,
    also: Sequence[str] = (),
) -> Selection:
    """Fit the linear model with its sensors, then try every effect.

    Effects are added in the order of `EFFECTS`. Each selected effect is then tested by removal, because an early effect
    may have explained what a later one explains better.

    Parameters
    ----------
    experiments
        Commands and readings, with or without a gyro; see `sensor_experiments`. Without a gyro, no effect between
        wheels and body is tried, and omega is that of the encoders.
    encoder_track
        Track with which the encoders' yaw rate was computed [m]. None if unknown: the track is then identified together
        with a top speed of the wheels, and steps of the wheels are not tried.
    on_trial
        Called with the name of the next trial.
    limits
        Limits of channels whose command is clipped according to a simpler model.
    only
        Names of the effects to try; None for all.
    also
        Free parameters in addition to `LINEAR`, from the first fit on.

    Raises
    ------
    ValueError
        If a reading never changes, or the records are too short for held-out blocks.
    """
    settings = effect_settings()
    gyro = experiments[0].outputs.shape[1] == len(SENSORS)
    free = (*(LINEAR if gyro else BY_ENCODERS), *also)
    start = {name: settings.parameters[name][2] for name in (*LINEAR, *also)} | ({} if gyro else _WITHOUT_GYRO)
    if encoder_track is not None:
        start[_TRACK] = encoder_track
    clipped = {f"limit.{channel}": level for channel, level in (limits or {}).items()}
    data = weight_readings(experiments)
    for _ in range(_ROUNDS):
        fit = fit_effects(start, free, data)
        start, data = dict(fit.point), weight_readings(experiments, fit.point)
    model = fit_folds(fit, data)
    effects: list[str] = []
    trials: list[EffectTrial] = []
    announce = on_trial or (lambda _: None)
    possible = _possible(gyro=gyro, track=encoder_track is not None, clipped=bool(clipped))
    for effect in [name for name in possible if only is None or name in only]:
        announce(effect)
        candidate = fit_folds(_with(model.fit, effect, data, clipped if effect == _CLIPPED else {}), data)
        worth = gain(model, candidate, data)
        significant = worth.gain > settings.certain * worth.error
        selected = significant and worth.gain > settings.worth and 2 * worth.blocks > len(model.points)
        trials.append(EffectTrial(effect, worth.gain, worth.blocks, selected, again=False))
        if selected:
            effects.append(effect)
            model, data = candidate, weight_readings(experiments, candidate.fit.point)
    for effect in tuple(effects):
        announce(f"without {effect}")
        candidate = fit_folds(_without(model.fit, effect, data), data)
        worth = gain(candidate, model, data)
        selected = worth.gain > settings.worth
        trials.append(EffectTrial(effect, worth.gain, worth.blocks, selected, again=True))
        if not selected:
            effects.remove(effect)
            model, data = candidate, weight_readings(experiments, candidate.fit.point)
    return Selection(_fit_to_convergence(model.fit, data), tuple(effects), tuple(trials), data, model.points)


def _possible(*, gyro: bool, track: bool, clipped: bool) -> list[str]:
    """Return the identifiable effects; `clipped` is True if the plain model has clipped commands."""
    excluded = {*(() if gyro else _BY_GYRO), *(() if track else _NEEDS_TRACK), *(() if clipped else (_CLIPPED,))}
    return [effect for effect in EFFECTS if effect not in excluded]


def _with(fit: EffectFit, effect: str, data: Weighted, known: Point) -> EffectFit:
    """Fit the model with one more effect; `known` overrides the initial values of the settings."""
    settings = effect_settings()
    guess = {name: settings.parameters[name][2] for name in EFFECTS[effect] if name in settings.parameters}
    guess = dict(known) or guess
    if "wheels.top_speed" in guess and _TRACK not in fit.point:
        return _with_track(fit, data)
    if "wheels.top_speed" in guess:
        guess["wheels.top_speed"] = _initial_top_speed(data.experiments)
    free = (*fit.free, *guess)
    start = {**fit.point, **guess}
    if "wheels.resolution" not in EFFECTS[effect]:
        return fit_effects(start, free, data)

    def with_step(step: float) -> EffectFit:
        return fit_effects({**start, "wheels.resolution": step}, free, data, settings.trial)

    best = min(map(with_step, settings.resolutions), key=_cost)
    rough = best.point["wheels.resolution"]
    for factor in settings.finer:  # each from the best so far: the search of the rough step may have ended early
        start = dict(best.point)
        best = min(best, with_step(factor * rough), key=_cost)
    return fit_effects(best.point, free, data, near=True)


def _with_track(fit: EffectFit, data: Weighted) -> EffectFit:
    """Fit a top speed of wheels with an unknown track, which the shape of the clipped commands determines."""
    settings = effect_settings()
    commands = np.concatenate([np.abs(experiment.inputs) for experiment in data.experiments])
    scale = 2.0 * commands[:, 0].max() / commands[:, 1].max()
    low, high, _ = settings.parameters[_TRACK]

    def fit_from(share: float) -> EffectFit:
        half = 0.5 * share * scale
        max_speed = float((commands[:, 0] + half * commands[:, 1]).max())
        unit = base_track({**fit.point, _TRACK: 1.0})
        guess = {"wheels.top_speed": 0.9 * max_speed, _TRACK: float(np.clip(2.0 * half / unit, low, high))}
        return fit_effects({**fit.point, **guess}, (*fit.free, *guess), data, settings.trial)

    best = min(map(fit_from, settings.wheel_bases), key=_cost)
    return fit_effects(best.point, best.free, data, near=True)


def _without(fit: EffectFit, effect: str, data: Weighted) -> EffectFit:
    removed = EFFECTS[effect]
    if "wheels.top_speed" in removed and _TRACK in fit.free:
        removed = (*removed, _TRACK)
    point: Point = {name: value for name, value in fit.point.items() if name not in removed}
    return fit_effects(point, [name for name in fit.free if name not in removed], data)


def _initial_top_speed(experiments: Sequence[SampledExperiment]) -> float:
    """Choose an initial top speed slightly below the maximum command; a limit that is never reached has no slope."""
    return 0.9 * max(float(np.abs(experiment.inputs[:, 0]).max()) for experiment in experiments)


def _fit_to_convergence(fit: EffectFit, data: Weighted) -> EffectFit:
    """Fit to convergence; parameters at a bound are fixed there.

    A pole too fast to be determined is fixed at the minimum time constant.
    """
    point = dict(fit.point)
    fixed = []
    for channel in CHANNELS:
        lag, damping = point[f"lag.{channel}"], max(point.get(f"damping.{channel}", 1.0), 1.0)
        slow = lag * (damping + np.sqrt(damping**2 - 1.0))
        if lag**2 / slow < _FASTEST < slow:
            lag = np.sqrt(slow * _FASTEST)
            point |= {f"lag.{channel}": lag, f"damping.{channel}": 0.5 * (slow + _FASTEST) / lag}
            fixed.append(f"damping.{channel}")
    # With a fixed fast pole, the short lag determines the slow pole, so it does not count as a lag at its bound.
    for name in [name for name in fit.free if name.replace("lag.", "damping.") not in fixed]:
        low, high, _ = effect_settings().parameters[name]
        for bound in (low, high):
            if abs(point[name] - bound) < _AT_BOUND * (high - low):
                point[name] = bound
    bounds = effect_settings().parameters
    free = [name for name in fit.free if name not in fixed and point[name] not in bounds[name][:2]]
    return fit_effects(point, free, data, near=True)


def _cost(fit: EffectFit) -> float:
    return fit.cost
