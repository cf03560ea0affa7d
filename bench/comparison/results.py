"""What a comparison gave, its rows in `bench.json`, and what it is a comparison of."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.case import DIMENSIONS, NO_SCENARIO, Case, label
from diffdrive_mpc.bench.comparison.plan import ComparisonSettings
from diffdrive_mpc.bench.comparison.properties import Property, property_rows
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.outcomes import STATISTICS, Outcome, S, Score, drawn_distances, metrics_row, plain
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.timing import UNDISTURBED, TimingPass
from diffdrive_mpc.bench.turns import AGAIN, BLOCK
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

TIMING = (
    "replays of the recorded measurements on one core, one BLAS thread, garbage collection off; controllers take turns "
    f"every {BLOCK} ticks, the first of which is not timed; blocks that counters or the yardstick call disturbed are "
    f"measured again, up to {AGAIN} times"
)


@dataclass(frozen=True)
class ComparisonResults:
    """What a comparison gave.

    Attributes
    ----------
    settings
        What was asked for.
    main
        Outcomes of the comparison.
    horizon
        Outcomes of the horizon sweep; they may be among `main` too.
    timing
        How the machine was while all was timed.
    properties
        Of the models on the plants.
    speed, dead_time, other_seeds
        See `CasePlan`; empty where they were not run.
    """

    settings: ComparisonSettings
    main: tuple[Outcome, ...]
    horizon: tuple[Outcome, ...]
    timing: TimingPass = UNDISTURBED
    properties: tuple[Property, ...] = ()
    speed: tuple[Score, ...] = ()
    dead_time: tuple[Score, ...] = ()
    other_seeds: tuple[Score, ...] = ()

    @property
    def all(self) -> tuple[Outcome, ...]:
        """Every outcome once, in order."""
        return tuple({outcome.case: outcome for outcome in (*self.main, *self.horizon)}.values())

    @property
    def silent(self) -> list[str]:
        """Dimensions that nobody asked for, and that are left out for it."""
        return [one.name for one in DIMENSIONS if one.silent and self.settings.values(one.several) == (one.default,)]

    def rows(self) -> list[dict[str, object]]:
        """Every run as plain values; what could not be computed is None."""
        swept, smoothed = any(self.settings.settings), bool(drawn_distances(self.all).any())
        return [row(one, self.silent, with_settings=swept, with_drawn=smoothed) for one in self.all]

    def content(self) -> dict[str, object]:
        """Everything as rows of plain values by name; parts that were not run are left out."""
        scored = {"speed": self.speed, "dead_time": self.dead_time, "other_seeds": self.other_seeds}
        rows = {"runs": self.rows(), "properties": property_rows(self.properties, self.main)}
        rows |= {name: [score_row(one, self.silent) for one in scores] for name, scores in scored.items()}
        return {name: part for name, part in rows.items() if part}


def row(
    outcome: Outcome, silent: Container[str], *, with_settings: bool = False, with_drawn: bool = False
) -> dict[str, object]:
    """One run as plain values.

    Parameters
    ----------
    outcome
        The run.
    silent
        Dimensions to leave out. Unless "scenario" is one of them, there are also the reason why the run ended before
        its time, begin and end of the disturbance [s] and the figures of the recovery from it.
    with_settings
        Add the swept configuration values under "set".
    with_drawn
        Add how far the reference is from the path as it was drawn.
    """
    case, run = outcome.case, outcome.run
    values = case.as_row(silent) | {"horizon": case.horizon} | metrics_row(outcome)
    values["timed_clean_percent"] = 100.0 * outcome.clean_share
    if with_settings:
        values["set"] = dict(case.overrides)
    if with_drawn:
        distance = drawn_distances([outcome])
        values |= {"drawn_max_m": distance.max(), "drawn_rms_m": np.sqrt(np.mean(distance**2))}
    if "scenario" not in silent:
        values |= {"ended": run.ended or None, "disturbance_s": run.disturbance} | asdict(run.recovery)
    row: dict[str, object] = plain(values)
    return row


def score_row(score: Score, silent: Container[str]) -> dict[str, object]:
    """A run that was not timed as plain values; `late_s` is by how much the plant was later than told."""
    case = score.case
    sample_time = controller_config(Case().model).sample_time
    values = case.as_row(silent) | {"top_speed_m_s": case.top_speed, "late_s": case.late * sample_time}
    row: dict[str, object] = plain(values | metrics_row(score, timed=False))
    return row


def predictive(compared: Mapping[str, Sequence[S]]) -> dict[str, list[S]]:
    """The groups of predictive controllers, which figures show; all groups where there are peers alone."""
    ours = {name: list(runs) for name, runs in compared.items() if runs[0].case.controller not in PEERS}
    return ours or {name: list(runs) for name, runs in compared.items()}


def incomplete(results: ComparisonResults) -> str | None:
    """One line about the runs of the predictive controller that did not complete; None where all did."""
    ours = [outcome for outcome in results.all if outcome.case.controller not in PEERS]
    failed = [outcome for outcome in ours if not outcome.metrics.completed]
    if not failed:
        return None
    case, ended = failed[0].case, failed[0].run.ended
    labels = case.labels
    first = f"{labels['model']} on {labels['trajectory']}, horizon {case.horizon}, seed {case.seed}"
    first += f", scenario {labels['scenario']}" if case.scenario != NO_SCENARIO else ""
    first += f" ({ended})" if ended else ""
    return f"{len(failed)} of {len(ours)} runs of mpc did not complete, the first: {first}; bench.json lists them"


def describe(settings: ComparisonSettings, timing: TimingPass) -> dict[str, object]:
    """Definitions, and what was asked for, for the `meta` part of `bench.json`.

    Parameters
    ----------
    settings
        What was asked for.
    timing
        How the machine was while all was timed.
    """
    asked: dict[str, object] = {one.several: labelled(settings, one.several) for one in DIMENSIONS}
    if not settings.ours:
        asked["models"] = []
    return {
        "step_times": TIMING,
        "timing": asdict(timing),
        "statistics": STATISTICS,
        "thresholds": metric_settings().model_dump(),
        "experiment": asked | {"horizons": settings.horizons},
        "configuration": {
            "file": None if settings.config is None else Path(settings.config).stem,
            "set": _swept(settings),
            "controllers": _configurations(settings) if settings.ours else [],
        },
    }


def labelled(settings: ComparisonSettings, dimension: str) -> list[object]:
    """Values of a dimension by its name in the plural, without what tells of the machine."""
    return [label(value) if isinstance(value, str) else value for value in settings.values(dimension)]


def chosen_configuration(settings: ComparisonSettings) -> str:
    """The configuration file and the values in place of the shipped ones, as one phrase; empty without any."""
    parts = [] if settings.config is None else [f"file {Path(settings.config).stem}"]
    parts += [f"{key}={','.join(map(str, values))}" for key, values in _swept(settings).items()]
    return "; ".join(parts)


def _configurations(settings: ComparisonSettings) -> list[dict[str, object]]:
    """Every value that each model's controller was given, for each combination of swept values."""
    return [
        {
            "model": label(model),
            "set": dict(overrides),
            "values": controller_config(model, settings.config, overrides).model_dump(mode="json")
            | {"model": label(model)},  # a path would tell of the machine
        }
        for model in settings.values("models")
        for overrides in settings.settings
    ]


def _swept(settings: ComparisonSettings) -> dict[str, list[object]]:
    """Values by dotted key, each once."""
    values: dict[str, list[object]] = {}
    for key, value in (pair for overrides in settings.settings for pair in overrides):
        known = values.setdefault(key, [])
        if value not in known:
            known.append(value)
    return values
