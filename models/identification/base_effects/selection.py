"""Which effects a base has: each is tried in turn, and kept only if it predicts held-out parts of the records better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.identification.base_effects.fitting import EffectFit, errors, fit_effects, power
from models.identification.base_effects.sensed import held_out, sensed
from models.identification.base_effects.settings import effect_settings
from models.identification.output_error.robust import output_spread, residual_scale
from models.identification.output_error.stretch import Stretch
from models.interface import FloatArray
from models.logs.record import Record

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
EFFECTS: Mapping[str, tuple[str, ...]] = {
    "twist slew": ("slew.v", "slew.omega"),
    "lag of the encoders": ("encoders.lag",),
    "top speed of the wheels": ("wheels.top_speed",),
    "veer": ("veer",),
    "yaw relaxation": ("relaxation",),
    "steps and coasting of the wheels": ("wheels.resolution", "wheels.coasting"),
    "different poles": ("spread.v", "spread.omega"),
}
"""Parameters of each effect, in the order in which they are tried."""
_NEEDS_TRACK = ("top speed of the wheels", "steps and coasting of the wheels")
_AT_ZERO = 2e-3


@dataclass(frozen=True)
class Trial:
    """One effect tried, in or out.

    Attributes
    ----------
    effect
        Its name, behind "without " where a kept one was tried anew.
    gain
        Fall of the logarithm of the held-out error power with it, mean over the sensors; above 0 it predicts better.
    better_blocks
        In how many blocks it did.
    kept
        Whether it belongs to the model after that.
    """

    effect: str
    gain: float
    better_blocks: int
    kept: bool


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
    scale
        (3,) scale of the residuals of each sensor.
    """

    fit: EffectFit
    effects: tuple[str, ...]
    trials: tuple[Trial, ...]
    scale: FloatArray


class _Bench:
    """The data, whole and with each block held out."""

    def __init__(self, records: Sequence[Record]) -> None:
        settings = effect_settings()
        self.whole = sensed(records)
        self.folds = [
            (sensed(rest), sensed(block)) for rest, block in held_out(records, settings.blocks, settings.shortest_part)
        ]
        self.spread = output_spread(self.whole)

    def scale(self, fit: EffectFit) -> FloatArray:
        return residual_scale(errors(fit.point, self.whole), self.spread)

    def held_out_errors(self, fit: EffectFit, scale: FloatArray) -> list[list[FloatArray]]:
        """For each block its errors under a model from the others."""
        trial = effect_settings().trial
        return [
            errors(fit_effects(fit.point, fit.free, rest, scale, trial).point, block) for rest, block in self.folds
        ]


def select_effects(
    records: Sequence[Record], encoder_track: float | None, on_trial: Callable[[str], None] | None = None
) -> Selection:
    """Fit the linear model with its sensors, then try every effect.

    Forwards in the order of `EFFECTS`, and then once more without each that was kept: an early one may have stood in
    for a later one.

    Parameters
    ----------
    records
        Records with encoders and gyro.
    encoder_track
        Track by which the encoders' yaw rate was computed [m]; None where it is not known: then nothing that happens
        to single wheels can be found.
    on_trial
        Called with the name of what is tried next.

    Raises
    ------
    ValueError
        If a record lacks a signal, a signal never changes, or the records are too short to hold blocks out.
    """
    bench = _Bench(records)
    settings = effect_settings()
    start = {name: settings.parameters[name][2] for name in LINEAR}
    if encoder_track is not None:
        start["encoders.track"] = encoder_track
    scale = bench.spread
    for _ in range(2):
        fit = fit_effects(start, LINEAR, bench.whole, scale)
        start, scale = dict(fit.point), bench.scale(fit)
    kept: list[str] = []
    trials: list[Trial] = []
    held = bench.held_out_errors(fit, scale)

    def judge(effect: str, candidate: EffectFit, found: list[list[FloatArray]]) -> tuple[float, int]:
        """Gain of the candidate over the model so far, and in how many blocks."""
        before = [np.log(power(block, scale)).mean() for block in held]
        after = [np.log(power(block, scale)).mean() for block in found]
        pooled = [np.log(power([e for block in blocks for e in block], scale)).mean() for blocks in (held, found)]
        return float(pooled[0] - pooled[1]), int(np.sum(np.array(after) < np.array(before)))

    for effect, names in EFFECTS.items():
        if effect in _NEEDS_TRACK and encoder_track is None:
            continue
        if on_trial is not None:
            on_trial(effect)
        candidate = _with(fit, effect, names, bench.whole, scale)
        found = bench.held_out_errors(candidate, scale)
        gain, blocks = judge(effect, candidate, found)
        wins = gain > settings.worth and 2 * blocks > settings.blocks
        trials.append(Trial(effect, gain, blocks, wins))
        if wins:
            kept.append(effect)
            fit, held, scale = candidate, found, bench.scale(candidate)
    for effect in tuple(kept):
        if on_trial is not None:
            on_trial(f"without {effect}")
        candidate = _without(fit, EFFECTS[effect], bench.whole, scale)
        found = bench.held_out_errors(candidate, scale)
        gain, blocks = judge(effect, candidate, found)
        needed = -gain > settings.worth
        trials.append(Trial(f"without {effect}", gain, blocks, needed))
        if not needed:
            kept.remove(effect)
            fit, held, scale = candidate, found, bench.scale(candidate)
    fit = _settled(fit, bench.whole, scale)
    return Selection(fit, tuple(kept), tuple(trials), bench.scale(fit))


def _with(
    fit: EffectFit, effect: str, names: tuple[str, ...], stretches: Sequence[Stretch], scale: FloatArray
) -> EffectFit:
    """The best fit with an effect more."""
    settings = effect_settings()
    guess = {name: settings.parameters[name][2] for name in names if name in settings.parameters}
    free = (*fit.free, *guess)
    if "wheels.resolution" not in names:
        return fit_effects({**fit.point, **_first_guess(guess, stretches)}, free, stretches, scale)

    def with_step(step: float) -> EffectFit:
        return fit_effects({**fit.point, **guess, "wheels.resolution": step}, free, stretches, scale, settings.trial)

    rough = min(map(with_step, settings.resolutions), key=lambda tried: tried.cost)
    fine = [with_step(rough.point["wheels.resolution"] * factor) for factor in settings.finer]
    best = min([rough, *fine], key=lambda tried: tried.cost)
    return fit_effects(best.point, free, stretches, scale)


def _first_guess(guess: Mapping[str, float], stretches: Sequence[Stretch]) -> Mapping[str, float]:
    """A top speed a little below the fastest command: one that is never met has no slope."""
    if "wheels.top_speed" not in guess:
        return guess
    fastest = max(float(np.abs(stretch.inputs[:, 0]).max()) for stretch in stretches)
    return {"wheels.top_speed": 0.9 * fastest}


def _without(fit: EffectFit, names: Sequence[str], stretches: Sequence[Stretch], scale: FloatArray) -> EffectFit:
    point = {name: value for name, value in fit.point.items() if name not in names}
    return fit_effects(point, [name for name in fit.free if name not in names], stretches, scale)


def _settled(fit: EffectFit, stretches: Sequence[Stretch], scale: FloatArray) -> EffectFit:
    """Dead times that ended at zero are zero, and no longer free."""
    gone = [name for name in fit.free if name.startswith("dead_time") and fit.point[name] < _AT_ZERO]
    free = [name for name in fit.free if name not in gone]
    return fit_effects({**fit.point, **dict.fromkeys(gone, 0.0)}, free, stretches, scale)
