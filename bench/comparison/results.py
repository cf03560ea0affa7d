"""Results of a comparison, their rows in `bench.json`, and the description of the settings."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import asdict, dataclass, field, fields

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.case import DIMENSIONS, NO_SCENARIO, Case, label
from diffdrive_mpc.bench.comparison.plan import ComparisonSettings
from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.experiment import concatenate, mean
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.run_row import CLOCK, STATISTICS, Row, SolverShares
from diffdrive_mpc.bench.timing import UNDISTURBED, TimingPass
from diffdrive_mpc.bench.turns import BLOCK, MAX_REPEATS
from diffdrive_mpc.sim import Metrics
from diffdrive_mpc.sim.metrics.recovery import Recovery
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings

TIMING = (
    "replays of the measurements of the first seed on one core with one BLAS thread and without garbage collection; "
    f"controllers alternate every {BLOCK} ticks, of which the first is not timed; blocks that are disturbed according "
    f"to counters or the yardstick, a fixed computation, are measured again, up to {MAX_REPEATS} times"
)


ROW_PARTS = ("speed", "dead_time", "other_seeds", "population", "dynamics")
"""Parts of the results that are stored as rows only, without runs."""


@dataclass(frozen=True)
class ComparisonResults:
    """Results of a comparison.

    Attributes
    ----------
    settings
        Settings of the comparison.
    main
        Rows of the comparison with their runs, see `bench.run_row.RunOutcome.row`.
    horizon
        Runs of the horizon sweep; `main` may contain some of them.
    timing
        State of the computer during all timed runs.
    speed, dead_time, other_seeds, population, dynamics
        Rows without runs, see `CasePlan`; empty if the part was not run.
    """

    settings: ComparisonSettings
    main: DataFrame
    horizon: DataFrame = field(default_factory=DataFrame)
    timing: TimingPass = UNDISTURBED
    speed: DataFrame = field(default_factory=DataFrame)
    dead_time: DataFrame = field(default_factory=DataFrame)
    other_seeds: DataFrame = field(default_factory=DataFrame)
    population: DataFrame = field(default_factory=DataFrame)
    dynamics: DataFrame = field(default_factory=DataFrame)

    @property
    def all(self) -> DataFrame:
        """All rows without repetition, in order."""
        return concatenate(self.main, self.horizon)

    @property
    def silent(self) -> list[str]:
        """Names of dimensions that rows omit because only their default was requested."""
        return [
            dimension.name
            for dimension in DIMENSIONS
            if dimension.silent and self.settings.values(dimension.plural) == (dimension.default,)
        ]

    def rows(self) -> list[Row]:
        """Return all runs as plain values; missing values are None."""
        swept, smoothed = any(self.settings.settings), bool((self.all["drawn_max_m"] > 0.0).any())
        rows = self.all.to_dict("records")
        return [json_row(row, self.silent, with_settings=swept, with_drawn=smoothed) for row in rows]

    def content(self) -> dict[str, object]:
        """Return all rows of plain values by name, without parts that were not run."""
        scored = {name: getattr(self, name) for name in ROW_PARTS}
        rows = {"runs": self.rows()}
        rows |= {
            name: [untimed_row(row, self.silent) for row in part.to_dict("records")] for name, part in scored.items()
        }
        return {name: part for name, part in rows.items() if part}


_STATISTICS = tuple(member.name for kind in (Metrics, SolverShares) for member in fields(kind))
_RECOVERY = tuple(member.name for member in fields(Recovery))


def json_row(row: Row, silent: Container[str], *, with_settings: bool = False, with_drawn: bool = False) -> Row:
    """Convert a run to plain values.

    Parameters
    ----------
    row
        Row of the run.
    silent
        Dimensions to omit. If they do not include "scenario", the row also contains the reason for an early end, start
        and end of the disturbance [s], and the recovery metrics.
    with_settings
        True to add the swept configuration values under "set".
    with_drawn
        True to add the distance of the reference from the path before smoothing [m].
    """
    values = row["case"].as_row(silent) | {name: row[name] for name in ("horizon", *_STATISTICS)}
    values["timed_clean_percent"] = 100.0 * row["clean_share"]
    if with_settings:
        values["set"] = dict(row["case"].overrides)
    if with_drawn:
        values |= {name: row[name] for name in ("drawn_max_m", "drawn_rms_m")}
    if "scenario" not in silent:
        values |= {"ended": row["ended"] or None, "disturbance_s": row["run"].disturbance}
        values |= {name: row[f"recovery_{name.removeprefix('recovery_')}"] for name in _RECOVERY}
    return dict(plain(values))


def untimed_row(row: Row, silent: Container[str]) -> Row:
    """Convert a run without timing to plain values; `late_s` is the delay of the plant minus the configured delay."""
    case = row["case"]
    sample_time = controller_config(Case().model).sample_time
    values = case.as_row(silent) | {"top_speed_m_s": case.top_speed, "late_s": case.late * sample_time}
    statistics = {name: row[name] for name in _STATISTICS if not name.startswith(CLOCK)}
    return dict(plain(values | statistics))


def mpc_groups(compared: Mapping[str, DataFrame]) -> dict[str, DataFrame]:
    """Return the groups of predictive controllers, or all groups if there are only peers."""
    groups = {name: rows for name, rows in compared.items() if rows["controller"].iloc[0] not in PEERS}
    return groups or dict(compared)


def completed_groups(compared: Mapping[str, DataFrame]) -> dict[str, DataFrame]:
    """Return the groups with only completed runs, whose errors are comparable."""
    return {name: rows for name, rows in compared.items() if rows["completed"].all()}


def best_of(compared: Mapping[str, DataFrame]) -> str:
    """Return the name with the lowest mean position RMSE."""
    return min(compared, key=lambda name: np.nan_to_num(mean(compared[name], "position_rmse_m"), nan=np.inf))


def describe_incomplete(results: ComparisonResults) -> str | None:
    """Describe the incomplete runs of the predictive controller in one line; None if all runs are complete."""
    rows = results.all
    mpc_rows = rows[~rows["controller"].isin(PEERS)]
    failed = mpc_rows[~mpc_rows["completed"].astype(bool)]
    if failed.empty:
        return None
    case, ended = failed[["case", "ended"]].iloc[0]
    labels = case.labels
    first = f"{labels['model']} on {labels['trajectory']}, horizon {case.horizon}, seed {case.seed}"
    first += f", scenario {labels['scenario']}" if case.scenario != NO_SCENARIO else ""
    first += f" ({ended})" if ended else ""
    return f"{len(failed)} of {len(mpc_rows)} runs of mpc did not complete, the first: {first}; bench.json lists them"


def describe(settings: ComparisonSettings, timing: TimingPass) -> dict[str, object]:
    """Describe definitions and settings for the `meta` part of `bench.json`.

    Parameters
    ----------
    settings
        Settings of the comparison.
    timing
        State of the computer during all timed runs.
    """
    options: dict[str, object] = {dimension.plural: labels_of(settings, dimension.plural) for dimension in DIMENSIONS}
    if not settings.has_mpc:
        options["models"] = []
    return {
        "step_times": TIMING,
        "timing": asdict(timing),
        "statistics": STATISTICS,
        "thresholds": metric_settings().model_dump(),
        "experiment": options | {"horizons": settings.horizons},
        "configuration": {
            "file": None if settings.config is None else label(settings.config),
            "set": _swept_values(settings),
            "controllers": _configurations(settings) if settings.has_mpc else [],
        },
    }


def labels_of(settings: ComparisonSettings, dimension: str) -> list[object]:
    """Return the values of a dimension by its plural name; paths are reduced to their stems."""
    return [label(value) if isinstance(value, str) else value for value in settings.values(dimension)]


def describe_configuration(settings: ComparisonSettings) -> str:
    """Describe the configuration file and changed values as a phrase; empty for built-in values."""
    parts = [] if settings.config is None else [f"file {label(settings.config)}"]
    parts += [f"{key}={','.join(map(str, values))}" for key, values in _swept_values(settings).items()]
    return "; ".join(parts)


def _configurations(settings: ComparisonSettings) -> list[dict[str, object]]:
    """List the configuration values of the controller of each model for each combination of swept values."""
    return [
        {
            "model": label(model),
            "set": dict(overrides),
            "values": controller_config(model, settings.config, overrides).model_dump(mode="json")
            | {"model": label(model)},  # only the stem of a path
        }
        for model in settings.values("models")
        for overrides in settings.settings
    ]


def _swept_values(settings: ComparisonSettings) -> dict[str, list[object]]:
    """Collect the distinct swept values by dotted key."""
    values: dict[str, list[object]] = {}
    for key, value in (pair for overrides in settings.settings for pair in overrides):
        collected = values.setdefault(key, [])
        if value not in collected:
            collected.append(value)
    return values
