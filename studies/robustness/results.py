"""Additional columns of a run, and tables and figure of the robustness study."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from pandas import DataFrame
from scipy.stats import binomtest, poisson

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.experiment import by, mean, total
from diffdrive_mpc.bench.figure_style import ERROR_MAP, new_figure
from diffdrive_mpc.bench.grouped_tables import Cell, load_tables
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.pose import wrap_angle
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.sim.plants.names import DRAWN
from diffdrive_mpc.sim.run import Run
from diffdrive_mpc_extras.campaign.campaign_file import Condition
from diffdrive_mpc_extras.campaign.drivable_robots import driving_seeds

MARKET = "market"
"""Name of the condition with random robots; each run has a different robot."""


def market_cases(
    robots: int,
    controller: str,
    model: str,
    trajectory: str,
    spot_turns: bool,
    *,
    tuning: bool = False,
    settings: Mapping[str, bool | int | float | str] | None = None,
) -> list[Case]:
    """List cases with the first `robots` reserved robots of the market that can drive a path; see `driving_seeds`.

    If `tuning` is True, the robots for tuning replace the reserved robots. The controllers are configured with the
    values that the user of the robot states, and with `settings`, configuration values by dotted key.
    """
    return [
        Condition(plant=f"{DRAWN}:{seed}", settings=dict(settings or {})).case(controller, model, trajectory, seed)
        for seed in driving_seeds(robots, spot_turns=spot_turns, tuning=tuning)
    ]


FALSE_ALARM_RATE = "monitor.false_alarm_rate"
"""Configuration key of the rate of false alarms [1/h]."""
MAX_LATERAL_ERROR = 0.05
"""Maximum lateral error of a run that stays on its path [m], from Guffanti et al. 2026."""
_UNUSED_SENSOR = re.compile(r"([a-z ]+?) not used: ")
"""Pattern of the name of an unused sensor in a message of the controller."""
_CONFIDENCE = 0.95
_HOUR = 3600.0


def condition_columns(settled: float, case: Case, run: Run) -> dict[str, object]:
    """Compute the columns of a run under a condition.

    `late_lateral_m` is the maximum |lateral| error after the time `settled` [s], or NaN if the run ends earlier.
    `heading_nees` is the mean squared error of the estimated heading over its variance, about 1 for a consistent
    estimate, or NaN if the controller has no estimate. `given_up` is the number of times that the controller stopped
    using a sensor, which are false alarms if no sensor is faulty. `within_room` is True if the lateral error did not
    exceed `MAX_LATERAL_ERROR`. `rate` is the configured rate of false alarms [1/h].
    """
    settled_errors = np.abs(run.errors.lateral[run.counted & (run.time >= settled)])
    rate = dict(case.overrides).get(FALSE_ALARM_RATE, ControllerConfig().monitor.false_alarm_rate)
    return {
        "late_lateral_m": float(np.max(settled_errors)) if settled_errors.size else float("nan"),
        "heading_nees": _heading_nees(run),
        "given_up": _count_unused_sensors(run),
        "within_room": run.metrics.lateral_max_m <= MAX_LATERAL_ERROR,
        "rate": number(float(str(rate)), 2),
    }


def _count_unused_sensors(run: Run) -> int:
    count, previous = 0, frozenset[str]()
    for message in run.messages:
        current = frozenset(_UNUSED_SENSOR.findall(message))
        count += len(current - previous)
        previous = current
    return count


def _heading_nees(run: Run) -> float:
    error, variance = wrap_angle(run.estimates[:, 2] - run.true_pose[:, 2]), run.estimate_deviations[:, 2] ** 2
    has_estimate = variance > 0.0
    return float(np.mean(error[has_estimate] ** 2 / variance[has_estimate])) if has_estimate.any() else float("nan")


def study_tables(rows: DataFrame) -> list[Table]:
    """Build the tables of errors by condition, error ratios, messages, and robots of the market."""
    specs = load_tables(Path(__file__).with_name("tables.yaml"))
    tables = [specs["conditions"].table(rows)]
    tables += [_ratio_table(rows)] if len(by(rows, "driver")) > 1 else []
    tables.append(_message_table(rows))
    market = rows[rows["condition"].str.startswith(MARKET)]
    if len(market):
        tables.append(specs["market"].table(market[market["condition"] == MARKET], CELLS))
        tables.append(specs["alarms"].table(market[market["controller"] == "mpc"], CELLS))
    return tables


def ratios(rows: DataFrame) -> dict[str, float]:
    """Compute the mean position RMSE of each controller, relative to the best controller that completed all runs.

    The ratios are NaN if no controller completed all runs.
    """
    drivers = by(rows, "driver")
    errors = {name: mean(runs, "position_rmse_m") for name, runs in drivers.items()}
    best = min((errors[name] for name, runs in drivers.items() if runs["completed"].all()), default=float("nan"))
    return {name: error / best for name, error in errors.items()}


def _ratio_table(rows: DataFrame) -> Table:
    entries = [((name,), ratios(group)) for name, group in by(rows, "condition").items()]
    columns = {name: _ratio_cell(name) for name in by(rows, "driver")}
    note = "Mean position RMSE, relative to the best controller that completed all runs of the condition."
    return Table.build("Error relative to the best controller", ("condition",), columns, entries, note)


def _ratio_cell(name: str) -> Callable[[Mapping[str, float]], str]:
    return lambda row: number(row.get(name, float("nan")), 2)


def _message_table(rows: DataFrame) -> Table:
    """Tabulate one message by condition and controller: the most frequent one of the run with the most messages."""
    selected = rows.loc[rows.groupby(["condition", "driver"], sort=False)["message_percent"].idxmax()]
    messages = selected[(selected["ended"] != "") | (selected["message"] != "")]
    entries = [((row.condition, row.driver, row.ended or row.message), row) for row in messages.itertuples()]
    note = "The most frequent message of the run with the most messages, and the share of ticks with any message."
    columns = {"ticks [%]": lambda row: number(row.message_percent, 0)}
    return Table.build("Messages of the controllers", ("condition", "controller", "message"), columns, entries, note)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of the share `count` / `total` [-]."""
    interval = binomtest(count, total).proportion_ci(_CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def alarms_interval(expected: float) -> tuple[int, int]:
    """Compute the interval of a Poisson distribution with mean `expected` that contains 95 % of the counts."""
    low, high = poisson.interval(_CONFIDENCE, expected)
    return int(low), int(high)


def _within_share(rows: DataFrame) -> str:
    low, high = share_interval(total(rows, "within_room"), len(rows))
    return f"{100 * rows['within_room'].mean():.0f} ({100 * low:.0f} to {100 * high:.0f})"


def _expected_alarms(rows: DataFrame) -> float:
    return float(rows["rate"].iloc[0]) * float(rows["driven_s"].sum()) / _HOUR


CELLS: Mapping[str, Cell] = {
    "within_share": _within_share,
    "hours": lambda rows: number(float(rows["driven_s"].sum()) / _HOUR, 2),
    "expected": lambda rows: number(_expected_alarms(rows), 1),
    "poisson": lambda rows: "{} to {}".format(*alarms_interval(_expected_alarms(rows))),
}


_MAX_RATIO = 10.0
"""Upper end of the colour scale of the ratios [-]."""


def draw_ratios(rows: DataFrame, path: Path) -> None:
    """Draw a heat map of the ratios with a row per condition and a column per controller.

    A cross marks a controller that did not complete all runs.
    """
    conditions, names = by(rows, "condition"), list(by(rows, "driver"))
    values = np.array([[ratios(group).get(name, np.nan) for name in names] for group in conditions.values()])
    with new_figure(path, 2.6 + 0.7 * len(names), 1.2 + 0.19 * len(conditions)) as figure:
        axes = figure.add_subplot()
        mesh = axes.imshow(values.clip(1.0, _MAX_RATIO), norm=LogNorm(1.0, _MAX_RATIO), cmap=ERROR_MAP, aspect="auto")
        axes.set_xticks(range(len(names)), names, rotation=30, ha="left")
        axes.xaxis.tick_top()
        axes.set_yticks(range(len(conditions)), list(conditions), fontsize=7)
        axes.grid(visible=False)
        for i, group in enumerate(conditions.values()):
            for k, name in enumerate(names):
                is_incomplete = not group[group["driver"] == name]["completed"].all()
                ratio = f"{values[i, k]:.2f}" if np.isfinite(values[i, k]) else "-"
                is_dark = not values[i, k] > _MAX_RATIO**0.5
                text = f"{ratio} ×" if is_incomplete else ratio
                axes.text(k, i, text, ha="center", va="center", fontsize=6.5, color="white" if is_dark else "black")
        figure.colorbar(mesh, ax=axes, label="position RMSE relative to the best controller", shrink=0.4)
