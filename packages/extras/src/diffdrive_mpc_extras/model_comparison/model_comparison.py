"""Comparison of model kinds on a log by cross-validation."""

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

# Maximum horizon at which the error of open-loop poses is compared [s].
_POSE_HORIZON = 5.0


class Kind(NamedTuple):
    """Kind of model in the comparison."""

    name: str
    structure: str = "sm"
    effects: bool = False
    predictor: str = ""
    """Predictor from `predictor.finders` that replaces the linear model; empty for the linear model."""
    slow: bool = False
    """True for kinds that are compared only if they are named, or with `all`."""
    effort: float = 1.0
    """Duration of the identification relative to the simplest kind, for the estimate of the remaining time."""


# Efforts are correct to the order of magnitude; each finished kind improves the estimate of the remaining time.
_SSM, _EFFECTS, _SLOW = 5.0, 10.0, 20.0


def _function_kinds(*, slow: bool) -> Iterator[Kind]:
    for structure in function_structures().values():
        if structure.slow == slow:
            yield Kind(structure.name, predictor=structure.name, slow=slow, effort=_SLOW if slow else 1.0)


KINDS = (
    Kind("sm"),
    Kind("ssm", "ssm", effort=_SSM),
    Kind("mbm", "mbm"),
    *_function_kinds(slow=False),
    Kind("sm+effects", effects=True, effort=_EFFECTS),
    *_function_kinds(slow=True),
)
"""Kinds, the simplest first. A later kind is recommended only if its prediction is significantly better."""
ALL = "all"
"""Name for all kinds, including the slow kinds."""
NO_MODEL = "no model"


@dataclass(frozen=True)
class KindScore:
    """Score of one kind on the held-out parts.

    Attributes
    ----------
    kind
        Name of the kind.
    states
        Order of the model of the last fold; 0 if there is no model.
    powers
        (B, 2) mean squared error of v [m/s] and omega [rad/s] in each held-out block of time.
    pose_error
        RMS position error of open-loop simulations at the horizon of the comparison [m]; NaN if there are no poses.
    seconds
        Duration of all identifications of the kind [s].
    failure
        Reason for a missing score, in one line; empty if there is a score.
    """

    kind: str
    states: int
    powers: FloatArray
    pose_error: float
    seconds: float
    failure: str = ""


@dataclass(frozen=True)
class ModelComparison:
    """Scores of several kinds on one log.

    Attributes
    ----------
    scores
        Scores, first without a model, then in the order of `KINDS`.
    weights
        (B, 2) number of readings in each block.
    spread
        (2,) variance of the measurements of v [m^2/s^2] and omega [rad^2/s^2].
    parts
        Number of folds of the cross-validation.
    horizon
        Horizon of `pose_error` [s].
    """

    scores: tuple[KindScore, ...]
    weights: FloatArray
    spread: FloatArray
    parts: int
    horizon: float

    def fits(self, score: KindScore, draw: FloatArray | None = None) -> FloatArray:
        """Compute the pooled FIT (..., 2) of v and omega [%], over all blocks or over resampled blocks (..., B)."""
        return pooled_fit(score.powers, self.weights, self.spread, draw)

    @property
    def recommended(self) -> KindScore:
        """Score of the simplest kind whose mean FIT is not significantly worse than that of a later kind."""
        valid = [score for score in self.scores if not score.failure]
        best = valid[0]
        for candidate in valid[1:]:
            if self.gain(candidate, best)[0] > 0.0:
                best = candidate
        return best

    def gain(self, score: KindScore, reference: KindScore) -> FloatArray:
        """Compute the 95 % interval (2,) of the mean FIT minus that of `reference` [points], by resampling blocks."""
        draws = draw_blocks(len(self.weights))
        difference = (self.fits(score, draws) - self.fits(reference, draws)).mean(axis=1)
        return np.asarray(np.quantile(difference, INTERVAL))

    def table(self) -> TextTable:
        """Return a table with a row for each kind."""
        recommended = self.recommended
        rows = []
        for score in self.scores:
            if score.failure:
                rows.append((score.kind, *["-"] * 6))
                continue
            v, omega = self.fits(score)
            low, high = self.gain(score, recommended)
            gain = "-" if score is recommended else f"{low:+.2f} to {high:+.2f}"
            rows.append(
                (
                    f"{score.kind} *" if score is recommended else score.kind,
                    str(score.states),
                    number(float(v), 2),
                    number(float(omega), 2),
                    gain,
                    number(score.pose_error),
                    f"{score.seconds:.0f}",
                )
            )
        columns = (
            *("kind", "states", "FIT v [%]", "FIT omega [%]", "mean FIT minus * [points]"),
            *(f"pose error at {self.horizon:g} s [m]", "identification [s]"),
        )
        note = (
            f"* recommended. {self.parts}-fold cross-validation: each model is simulated from the commands over a part "
            "of the rows that its identification did not use. Intervals: 95 %, from resampled blocks of time."
        )
        return TextTable("Comparison of model kinds", columns, tuple(rows), note=note)

    def line(self, score: KindScore) -> str:
        """Format the score of one kind as a line."""
        if score.failure:
            return f"{score.kind}: not identified: {score.failure}"
        v, omega = self.fits(score)
        return f"{score.kind}: FIT v {v:.2f} %, omega {omega:.2f} %, identified in {score.seconds:.0f} s"

    def sentence(self) -> str:
        """Format the recommendation and the differences to the other kinds."""
        recommended = self.recommended
        rivals = [
            score for score in self.scores if score is not recommended and not score.failure and score.kind != NO_MODEL
        ]
        clauses = []
        for rival in rivals:
            low, high = self.gain(rival, recommended)
            if high < 0.0:
                clauses.append(f"{rival.kind} is worse by {-high:.1f} to {-low:.1f} points")
            else:
                clauses.append(f"{rival.kind} is not significantly better ({low:+.1f} to {high:+.1f} points)")
        clauses += [f"{score.kind} was not identified: {score.failure}" for score in self.scores if score.failure]
        return f"{recommended.kind}: {'; '.join(clauses) or 'no other kind to compare with'}"


def compare_models(
    data: LogData,
    kinds: Sequence[str] = (),
    parts: int = 3,
    on_progress: Callable[[str, float], None] = lambda _text, _share: None,
    on_score: Callable[[ModelComparison], None] = lambda _: None,
) -> ModelComparison:
    """Compare model kinds by cross-validation: identify each kind without a part of the log, and score it on the part.

    Parameters
    ----------
    data
        Records from `read_data`; training and validation records are joined.
    kinds
        Names from `KINDS`, or "all"; by default all kinds that are not slow.
    parts
        Number of parts of equal duration, at least 2.
    on_progress
        Callback with a description of the next step and the finished fraction of the work.
    on_score
        Callback with the comparison after each kind; the new score is the last.

    Raises
    ------
    ConfigError
        If a kind is unknown, `parts` is less than 2, or there are too few rows.
    """
    unknown = [name for name in kinds if name not in {ALL, *(kind.name for kind in KINDS)}]
    if unknown:
        raise ConfigError(f"kind '{unknown[0]}': give names from {', '.join(kind.name for kind in KINDS)}, or {ALL}")
    if parts < 2:
        raise ConfigError(f"parts = {parts}: give 2 or more; each part is held out once")
    folds = list(_folds([*data.train, *data.validation], parts))
    horizon = max(h for h in identification_settings().horizons if h <= _POSE_HORIZON)
    measured = [part for _, held_out in folds for part in twist_experiments(held_out, data.yaw)]
    readings = np.concatenate([part.outputs[part.counts.all(axis=1)] for part in measured])
    if not len(readings):
        raise ConfigError("no row has readings of both v and omega; log them at the same rate")
    # Without a model, the prediction is that the robot follows the commands exactly.
    powers, weights = block_powers(measured, [record.command for _, held_out in folds for record in held_out])
    scores = [KindScore(NO_MODEL, 0, powers, float("nan"), 0.0)]
    linear: dict[tuple[str, bool, int], Fitted] = {}
    selected = [kind for kind in KINDS if ALL in kinds or (kind.name in kinds if kinds else not kind.slow)]
    total_effort, effort = sum(kind.effort for kind in selected), 0.0
    comparison = ModelComparison(tuple(scores), weights, readings.var(axis=0), parts, horizon)
    for i, kind in enumerate(selected):

        def announce(part: int, kind: Kind = kind, i: int = i, effort: float = effort) -> None:
            text = f"{kind.name}, kind {i + 1} of {len(selected)}, part {part + 1} of {parts}"
            on_progress(text, (effort + kind.effort * part / parts) / total_effort)

        scores.append(_score(kind, data, folds, linear, measured, horizon, announce))
        effort += kind.effort
        comparison = replace(comparison, scores=tuple(scores))
        on_score(comparison)
    return comparison


def _folds(records: Sequence[Record], parts: int) -> Sequence[tuple[list[Record], list[Record]]]:
    """Return the training and the held-out records of each fold, without records that are too short."""
    folds, min_rows = [], 2 * identification_settings().min_readings
    for k in range(parts):
        before, remainder = divide(records, k / parts)
        part, after = divide(remainder, 1.0 / (parts - k))
        rest, part = (
            [record for record in group if len(record.command) >= min_rows] for group in ([*before, *after], part)
        )
        if not (rest and part):
            raise ConfigError(f"too few rows for cross-validation with {parts} parts; give a longer log or fewer parts")
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
) -> KindScore:
    """Score one kind; `linear` caches linear models by structure, effects and part, since several kinds use them."""
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
            return KindScore(kind.name, 0, np.empty((0, 2)), float("nan"), seconds, str(error))
        simulated += fitted.simulated
        states, seconds = fitted.states, seconds + fitted.seconds
        errors += [drift.position_rmse for drift in poses.drift if drift.horizon == horizon]
    pose = float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")
    return KindScore(kind.name, states, block_powers(measured, simulated)[0], pose, seconds)
