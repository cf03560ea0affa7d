"""Tables of robots of the market: how many arrive, keep to their path, or are stopped without a reason."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest, poisson

from diffdrive_mpc.bench.cells import Cell, command_rate, completed, time_behind, total_of
from diffdrive_mpc.bench.conditions import MARKET
from diffdrive_mpc.bench.outcomes import group
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.mpc import ControllerConfig
from studies.robustness.results import ROOM, ConditionOutcome, Rows

FALSE_ALARM_RATE = "monitor.false_alarm_rate"
"""Key of the rate of false alarms that the controller is configured for [1/h]."""
_CONFIDENCE = 0.95
_HOUR = 3600.0


def share_interval(count: int, of: int) -> tuple[float, float]:
    """Wilson's interval of 95 % of a share, from `count` of `of` [-]."""
    interval = binomtest(count, of).proportion_ci(_CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def alarms_interval(expected: float) -> tuple[int, int]:
    """Counts between which 95 % of the draws lie of Poisson's distribution with the mean `expected`."""
    low, high = poisson.interval(_CONFIDENCE, expected)
    return int(low), int(high)


def market_tables(rows: Rows) -> list[Table]:
    """Outcomes by controller, and alarms by the rate that was asked for; none without robots of the market."""
    market = [row for row in rows if row.condition.startswith(MARKET)]
    if not market:
        return []
    by_driver = group([row for row in market if row.condition == MARKET], lambda row: row.driver)
    columns: dict[str, Cell] = {
        "drives": lambda runs: str(len(runs)),
        "arrive": completed,
        "stops": total_of("stopped"),
        "sensors given up": lambda runs: str(sum(run.given_up for run in runs)),
        "within 5 cm [%]": lambda runs: _share([run.metrics.lateral_max_m <= ROOM for run in runs]),
        "position RMSE, median [mm]": lambda runs: _percentile(runs, 50),
        "90 % [mm]": lambda runs: _percentile(runs, 90),
        "time behind [s]": time_behind,
        "rate of omega_ref [rad/s^2]": command_rate("omega"),
    }
    note = (
        "Every sensor of these robots is honest: a stop, or a sensor given up, is false. In brackets: Wilson's "
        "interval of 95 %. Time behind: largest of a drive, mean. Rate: RMS of a drive, mean."
    )
    entries = [((driver,), runs) for driver, runs in by_driver.items()]
    tables = [Table.of("Robots of the market", ("controller",), columns, entries, note)]
    return [*tables, _alarm_table(market)]


def _alarm_table(market: Rows) -> Table:
    ours = [row for row in market if row.case.controller == "mpc"]
    entries = [((number(rate, 2),), runs) for rate, runs in group(ours, _rate).items()]
    columns: dict[str, Cell] = {
        "hours": lambda runs: number(_hours(runs), 2),
        "alarms": lambda runs: str(sum(run.given_up for run in runs)),
        "expected": lambda runs: number(_expected(runs), 1),
        "95 % of the counts": lambda runs: "{} to {}".format(*alarms_interval(_expected(runs))),
    }
    note = "Sensors given up in all drives of the predictive controller at a rate, beside the Poisson distribution."
    return Table.of("False alarms", ("asked for [1/h]",), columns, entries, note)


def _rate(row: ConditionOutcome) -> float:
    """Rate of false alarms that a drive was configured for [1/h]."""
    asked = dict(row.case.overrides).get(FALSE_ALARM_RATE)
    return float(str(asked)) if asked is not None else ControllerConfig().monitor.false_alarm_rate


def _expected(runs: Sequence[ConditionOutcome]) -> float:
    return _rate(runs[0]) * _hours(runs)


def _hours(runs: Sequence[ConditionOutcome]) -> float:
    return sum(run.driven_s for run in runs) / _HOUR


def _share(kept: Sequence[bool]) -> str:
    low, high = share_interval(sum(kept), len(kept))
    return f"{100 * sum(kept) / len(kept):.0f} ({100 * low:.0f} to {100 * high:.0f})"


def _percentile(runs: Sequence[ConditionOutcome], percent: float) -> str:
    return number(1e3 * float(np.percentile([run.metrics.position_rmse_m for run in runs], percent)), 1)
