"""Which effects a base has: each is tried, and kept only if it predicts held-out parts of the records better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.identification.effects.fitting import EffectFit, Weighted, fit_effects, weighted
from diffdrive_mpc.models.identification.effects.free_run import Point
from diffdrive_mpc.models.identification.effects.settings import effect_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import Experiment
from diffdrive_mpc.models.output_error.held_out import blocks

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
_CLIPPED = "clipped commands"
EFFECTS: Mapping[str, tuple[str, ...]] = {
    _CLIPPED: ("limit.v", "limit.omega"),
    "twist slew": ("slew.v", "slew.omega"),
    "lag of the encoders": ("encoders.lag",),
    "top speed of the wheels": ("wheels.top_speed",),
    "steps and coasting of the wheels": ("wheels.resolution", "wheels.coasting"),
    "yaw relaxation": ("relaxation",),
    "veer": ("veer",),
    "different poles": ("spread.v", "spread.omega"),
}
"""Parameters of each effect, in the order in which they are tried."""
_OF_SINGLE_WHEELS = ("top speed of the wheels", "steps and coasting of the wheels")
_ROUNDS = 2
_AT_BOUND = 3e-3
"""Of the range of a parameter."""


@dataclass(frozen=True)
class Tried:
    """A fit to all data, and the same model without each block.

    Attributes
    ----------
    fit
        From all data.
    points
        The parameters found without each block.
    """

    fit: EffectFit
    points: tuple[Point, ...]


def tried(fit: EffectFit, data: Weighted) -> Tried:
    """Search anew, from `fit`, without each block in turn."""
    trial = effect_settings().trial
    folds = blocks(data.experiments)
    fits = [fit_effects(fit.point, fit.free, data.part(rest), trial, near=True) for rest, _ in folds]
    return Tried(fit, tuple(found.point for found in fits))


class Worth(NamedTuple):
    """What one model is worth over another on held-out blocks."""

    gain: float
    """fall of the logarithm of the error power, mean over sensors"""
    error: float
    """its standard error, from the scatter between blocks"""
    blocks: int
    """in how many the power falls"""


def gain(old: Tried, new: Tried, data: Weighted) -> Worth:
    """Compare two models by the blocks that they were made without."""
    powers = np.array([_powers(model, data) for model in (old, new)])
    falls = -np.diff(np.log(powers).mean(axis=2), axis=0)[0]
    whole = np.log(powers.sum(axis=1)).mean(axis=1)
    error = float(falls.std(ddof=1) / np.sqrt(len(falls)))
    return Worth(float(whole[0] - whole[1]), error, int(np.sum(falls > 0)))


def _powers(model: Tried, data: Weighted) -> FloatArray:
    """(blocks, 3) sum of the squared weighted errors of each sensor in each block, by the model found without it."""
    parts = [data.part(block) for _, block in blocks(data.experiments)]
    return np.array(
        [
            np.sum([np.nansum(error**2, axis=0) for error in part.errors(point)], axis=0)
            for part, point in zip(parts, model.points, strict=True)
        ]
    )


@dataclass(frozen=True)
class Trial:
    """One effect tried, in or out.

    Attributes
    ----------
    effect
        Its name.
    gain
        What it is worth: fall of the logarithm of the held-out error power with it, mean over the sensors.
    blocks
        In how many blocks it predicts better.
    kept
        Whether it belongs to the model after that.
    again
        Whether an effect that was kept was tried once more, beside all others.
    """

    effect: str
    gain: float
    blocks: int
    kept: bool
    again: bool


@dataclass(frozen=True)
class Selection:
    """What was found.

    Attributes
    ----------
    fit
        The estimate from all records, with the effects kept.
    effects
        Their names.
    trials
        What was tried, in this order.
    data
        The readings as weighted in the end.
    points
        The parameters found without each block of the records.
    """

    fit: EffectFit
    effects: tuple[str, ...]
    trials: tuple[Trial, ...]
    data: Weighted
    points: tuple[Point, ...]


def select_effects(
    experiments: Sequence[Experiment],
    encoder_track: float | None,
    on_trial: Callable[[str], None] | None = None,
    limits: Mapping[str, float] | None = None,
) -> Selection:
    """Fit the linear model with its sensors, then try every effect.

    Forwards in the order of `EFFECTS`, and then once more without each that was kept: an early one may have stood in
    for a later one.

    Parameters
    ----------
    experiments
        Commands and readings; see `sensed`.
    encoder_track
        Track by which the encoders' yaw rate was computed [m]; None where it is not known: then nothing that happens
        to single wheels is tried.
    on_trial
        Called with the name of what is tried next.
    limits
        Of channels whose command a simpler model found to be clipped.

    Raises
    ------
    ValueError
        If a reading never changes, or the records are too short to hold blocks out.
    """
    settings = effect_settings()
    start = {name: settings.parameters[name][2] for name in LINEAR}
    if encoder_track is not None:
        start["encoders.track"] = encoder_track
    clipped = {f"limit.{channel}": level for channel, level in (limits or {}).items()}
    data = weighted(experiments)
    for _ in range(_ROUNDS):
        fit = fit_effects(start, LINEAR, data)
        start, data = dict(fit.point), weighted(experiments, fit.point)
    model = tried(fit, data)
    effects: list[str] = []
    trials: list[Trial] = []
    for effect in EFFECTS:
        known = {name: value for name, value in clipped.items() if name in EFFECTS[effect]}
        if (effect in _OF_SINGLE_WHEELS and encoder_track is None) or (effect == _CLIPPED and not known):
            continue
        if on_trial is not None:
            on_trial(effect)
        candidate = tried(_with(model.fit, effect, data, known), data)
        worth = gain(model, candidate, data)
        sure = worth.gain > settings.certain * worth.error
        kept = sure and worth.gain > settings.worth and 2 * worth.blocks > len(model.points)
        trials.append(Trial(effect, worth.gain, worth.blocks, kept, again=False))
        if kept:
            effects.append(effect)
            model, data = candidate, weighted(experiments, candidate.fit.point)
    for effect in tuple(effects):
        if on_trial is not None:
            on_trial(f"without {effect}")
        candidate = tried(_without(model.fit, effect, data), data)
        worth = gain(candidate, model, data)
        kept = worth.gain > settings.worth
        trials.append(Trial(effect, worth.gain, worth.blocks, kept, again=True))
        if not kept:
            effects.remove(effect)
            model, data = candidate, weighted(experiments, candidate.fit.point)
    return Selection(_settled(model.fit, data), tuple(effects), tuple(trials), data, model.points)


def _with(fit: EffectFit, effect: str, data: Weighted, known: Point) -> EffectFit:
    """The best fit with an effect more, begun from what is known of its parameters."""
    settings = effect_settings()
    guess = {name: settings.parameters[name][2] for name in EFFECTS[effect] if name in settings.parameters}
    guess = dict(known) or guess
    free = (*fit.free, *guess)
    if "wheels.top_speed" in guess:
        guess["wheels.top_speed"] = _little_less_than_fastest(data.experiments)
    start = {**fit.point, **guess}
    if "wheels.resolution" not in EFFECTS[effect]:
        return fit_effects(start, free, data)

    def with_step(step: float) -> EffectFit:
        return fit_effects({**start, "wheels.resolution": step}, free, data, settings.trial)

    best = min(map(with_step, settings.resolutions), key=_cost)
    rough = best.point["wheels.resolution"]
    for factor in settings.finer:  # each from the best so far: the search may have ended early for the rough one
        start = dict(best.point)
        best = min(best, with_step(factor * rough), key=_cost)
    return fit_effects(best.point, free, data, near=True)


def _without(fit: EffectFit, effect: str, data: Weighted) -> EffectFit:
    gone = EFFECTS[effect]
    point: Point = {name: value for name, value in fit.point.items() if name not in gone}
    return fit_effects(point, [name for name in fit.free if name not in gone], data)


def _little_less_than_fastest(experiments: Sequence[Experiment]) -> float:
    """A top speed that is never met has no slope."""
    return 0.9 * max(float(np.abs(experiment.inputs[:, 0]).max()) for experiment in experiments)


def _settled(fit: EffectFit, data: Weighted) -> EffectFit:
    """Fitted to the end; what went to a bound of the search stays there and is no longer free."""
    point = dict(fit.point)
    for name in fit.free:
        low, high, _ = effect_settings().parameters[name]
        for bound in (low, high):
            if abs(point[name] - bound) < _AT_BOUND * (high - low):
                point[name] = bound
    free = [name for name in fit.free if point[name] not in effect_settings().parameters[name][:2]]
    return fit_effects(point, free, data, near=True)


def _cost(fit: EffectFit) -> float:
    return fit.cost
