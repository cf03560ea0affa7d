"""Comparison of the kinds of model that a log supports, by cross-validation on parts of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.errors import MissingPackageError
from diffdrive_mpc.models.function_structure import function_structures
from diffdrive_mpc.models.identification.deliver.trust import INTERVAL, block_powers, draw_blocks, pooled_fit
from diffdrive_mpc.models.identification.fit.fitting import Fitted, fit, with_predictor
from diffdrive_mpc.models.identification.fit.poses import from_poses
from diffdrive_mpc.models.identification.fit.predictor import finders
from diffdrive_mpc.models.identification.log_data import LogData, divide
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Record
from diffdrive_mpc.models.output_error.experiment import SampledExperiment, twist_experiments
from diffdrive_mpc.models.structures.registry import STRUCTURES
from diffdrive_mpc.models.table import TextTable, number

# Open-loop poses are compared after this time, or the longest shorter one that is measured [s].
_POSE_HORIZON = 5.0


class Kind(NamedTuple):
    """A kind of model; the simpler ones come first."""

    name: str
    structure: str = "sm"
    effects: bool = False
    predictor: str = ""
    """Name in `predictor.finders` of the predictor in place of the structure's model."""
    slow: bool = False
    """Compared only where it is named, or all are asked for"""
    effort: float = 1.0
    """Time that its identification takes, over that of the simplest; only for estimates of the time that is left"""


_SSM, _EFFECTS, _SLOW = 5.0, 10.0, 20.0
# Efforts are rough: the remaining time is known to the order of magnitude, and better after every kind.


def _functions(*, slow: bool) -> Iterator[Kind]:
    for structure in function_structures().values():
        if structure.slow == slow:
            yield Kind(structure.name, predictor=structure.name, slow=slow, effort=_SLOW if slow else 1.0)


KINDS = (
    Kind("sm"),
    Kind("ssm", "ssm", effort=_SSM),
    Kind("mbm", "mbm"),
    *_functions(slow=False),
    Kind("sm+effects", effects=True, effort=_EFFECTS),
    *_functions(slow=True),
)
"""Compared kinds, the simplest first. A later one must predict better by more than chance."""
ALL = "all"
"""In place of names: the slow ones, too."""
NO_MODEL = "no model"


@dataclass(frozen=True)
class Scored:
    """One kind on the parts held out.

    Attributes
    ----------
    kind
        Name of the kind.
    states
        States of the model from the last part's rest; 0 without one.
    powers
        (B, 2) mean square error of v [m/s] and omega [rad/s] in each block of time held out.
    pose_error
        Root mean square of the open-loop position error after the longest time measured [m]; NaN without poses.
    seconds
        Duration of all identifications of the kind [s].
    failure
        Reason for a missing score, in a line; empty where there is.
    """

    kind: str
    states: int
    powers: FloatArray
    pose_error: float
    seconds: float
    failure: str = ""


@dataclass(frozen=True)
class ModelComparison:
    """Kinds of model side by side on one log.

    Attributes
    ----------
    scores
        No model first, then as in `KINDS`.
    weights
        (B, 2) readings behind each block.
    spread
        (2,) variance of the measurements, about their mean.
    parts
        Number of parts that were held out in turn.
    horizon
        Time after which `pose_error` is measured [s].
    """

    scores: tuple[Scored, ...]
    weights: FloatArray
    spread: FloatArray
    parts: int
    horizon: float

    def fits(self, scored: Scored, draw: FloatArray | None = None) -> FloatArray:
        """Compute (..., 2) pooled FIT of v and omega [%], or of resampled blocks (..., B)."""
        return pooled_fit(scored.powers, self.weights, self.spread, draw)

    @property
    def recommended(self) -> Scored:
        """The simplest kind that no more elaborate one beats by more than its uncertainty, in mean FIT."""
        able = [score for score in self.scores if not score.failure]
        best = able[0]
        for candidate in able[1:]:
            if self.gain(candidate, best)[0] > 0.0:
                best = candidate
        return best

    def gain(self, scored: Scored, reference: Scored) -> FloatArray:
        """Compute the 95 % interval (2,) of the mean FIT over that of `reference` [points], by resampling blocks."""
        draws = draw_blocks(len(self.weights))
        difference = (self.fits(scored, draws) - self.fits(reference, draws)).mean(axis=1)
        return np.asarray(np.quantile(difference, INTERVAL))

    def table(self) -> TextTable:
        """Tabulate one row for each kind."""
        chosen = self.recommended
        rows = []
        for score in self.scores:
            if score.failure:
                rows.append((score.kind, *["-"] * 6))
                continue
            v, omega = self.fits(score)
            low, high = self.gain(score, chosen)
            against = "-" if score is chosen else f"{low:+.2f} to {high:+.2f}"
            rows.append(
                (
                    f"{score.kind} *" if score is chosen else score.kind,
                    str(score.states),
                    number(float(v), 2),
                    number(float(omega), 2),
                    against,
                    number(score.pose_error),
                    f"{score.seconds:.0f}",
                )
            )
        columns = (
            *("kind", "states", "FIT v [%]", "FIT omega [%]", "mean FIT over * [points]"),
            *(f"pose after {self.horizon:g} s [m]", "found in [s]"),
        )
        note = (
            f"* recommended. Each kind identified {self.parts} times, each time without one part of the rows, and "
            "simulated over that part from the commands alone. Interval: 95 %, blocks of time drawn anew."
        )
        return TextTable("Which model for this robot", columns, tuple(rows), note=note)

    def line(self, scored: Scored) -> str:
        """Format the score of one kind, before there is a table."""
        if scored.failure:
            return f"{scored.kind}: not found: {scored.failure}"
        v, omega = self.fits(scored)
        return f"{scored.kind}: FIT v {v:.2f} %, omega {omega:.2f} %, found in {scored.seconds:.0f} s"

    def sentence(self) -> str:
        """Format the recommendation with its margin."""
        chosen = self.recommended
        others = [
            score for score in self.scores if score is not chosen and not score.failure and score.kind != NO_MODEL
        ]
        words = []
        for rival in others:
            low, high = self.gain(rival, chosen)
            if high < 0.0:
                words.append(f"{rival.kind} is worse by {-high:.1f} to {-low:.1f} points")
            else:
                words.append(
                    f"{rival.kind} is no better by more than its uncertainty ({low:+.1f} to {high:+.1f} points)"
                )
        words += [f"{failed.kind} was not found: {failed.failure}" for failed in self.scores if failed.failure]
        return f"{chosen.kind}: " + "; ".join(words) if words else f"{chosen.kind}: nothing to hold it against"


def compare_models(
    data: LogData,
    kinds: Sequence[str] = (),
    parts: int = 3,
    on_progress: Callable[[str, float], None] = lambda _text, _share: None,
    on_scored: Callable[[ModelComparison], None] = lambda _: None,
) -> ModelComparison:
    """Identify every kind without each part of the records in turn, and score it on that part.

    Parameters
    ----------
    data
        All records, as `read_data` gives them; how they are divided there does not matter.
    kinds
        Names in `KINDS`, or "all"; by default all that are not slow.
    parts
        Number of parts of equal length in time, at least 2.
    on_progress
        Called with the next step, and the finished part of the work.
    on_scored
        Called with the scores so far whenever a kind is scored, the new one last.

    Raises
    ------
    ConfigError
        If a kind is unknown, or there are too few rows.
    """
    unknown = [name for name in kinds if name not in {ALL, *(kind.name for kind in KINDS)}]
    if unknown:
        raise ConfigError(f"kind '{unknown[0]}': give some of {', '.join(kind.name for kind in KINDS)}, or {ALL}")
    if parts < 2:
        raise ConfigError(f"parts = {parts}: give 2 or more, one of them is held out at a time")
    folds = list(_folds([*data.train, *data.validation], parts))
    horizon = max(h for h in identification_settings().horizons if h <= _POSE_HORIZON)
    measured = [part for _, held_out in folds for part in twist_experiments(held_out, data.yaw)]
    readings = np.concatenate([part.outputs[part.counts.all(axis=1)] for part in measured])
    if not len(readings):
        raise ConfigError("no row has both a reading of v and one of omega; log them at the same rate")
    obeyed, weights = block_powers(measured, [record.command for _, held_out in folds for record in held_out])
    scores = [Scored(NO_MODEL, 0, obeyed, float("nan"), 0.0)]
    linear: dict[tuple[str, bool, int], Fitted] = {}
    chosen = [kind for kind in KINDS if ALL in kinds or (kind.name in kinds if kinds else not kind.slow)]
    total, done = sum(kind.effort for kind in chosen), 0.0
    comparison = ModelComparison(tuple(scores), weights, readings.var(axis=0), parts, horizon)
    for i, kind in enumerate(chosen):

        def announce(part: int, kind: Kind = kind, i: int = i, done: float = done) -> None:
            text = f"{kind.name}, kind {i + 1} of {len(chosen)}, part {part + 1} of {parts}"
            on_progress(text, (done + kind.effort * part / parts) / total)

        scores.append(_score(kind, data, folds, linear, measured, horizon, announce))
        done += kind.effort
        comparison = replace(comparison, scores=tuple(scores))
        on_scored(comparison)
    return comparison


def _folds(records: Sequence[Record], parts: int) -> Sequence[tuple[list[Record], list[Record]]]:
    """Return for each part the rest and the part, without short ends of stretches."""
    folds, fewest = [], 2 * identification_settings().min_readings
    for k in range(parts):
        before, behind = divide(records, k / parts)
        part, after = divide(behind, 1.0 / (parts - k))
        rest, part = (
            [record for record in some if len(record.command) >= fewest] for some in ([*before, *after], part)
        )
        if not (rest and part):
            raise ConfigError(f"too few rows to hold {parts} parts out in turn; give a longer log, or fewer parts")
        folds.append((rest, part))
    return folds


def _score(
    kind: Kind,
    data: LogData,
    folds: Sequence[tuple[list[Record], list[Record]]],
    linear: dict[tuple[str, bool, int], Fitted],
    measured: Sequence[SampledExperiment],
    horizon: float,
    announce: Callable[[int], None],
) -> Scored:
    """Score one kind; `linear` caches linear models by structure, effects and part, as several kinds need them."""
    simulated: list[FloatArray] = []
    states, seconds = 0, 0.0
    errors: list[float] = []
    for k, (rest, part) in enumerate(folds):
        announce(k)
        fold = replace(data, train=tuple(rest), validation=tuple(part))
        try:
            find = finders()[kind.predictor]() if kind.predictor else None
            key = (kind.structure, kind.effects, k)
            if key not in linear:
                linear[key] = fit(fold, STRUCTURES[kind.structure], effects=kind.effects)
            fitted = linear[key] if find is None else with_predictor(fold, linear[key], find)
            poses = from_poses(fold, fitted)
        except (ValueError, ConfigError, MissingPackageError) as error:
            return Scored(kind.name, 0, np.empty((0, 2)), float("nan"), seconds, str(error))
        simulated += fitted.simulated
        states, seconds = fitted.states, seconds + fitted.seconds
        errors += [drift.position_rmse for drift in poses.drift if drift.horizon == horizon]
    pose = float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")
    return Scored(kind.name, states, block_powers(measured, simulated)[0], pose, seconds)
