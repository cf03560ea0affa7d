"""Tables, charts and texts of the report of a proof."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.bench.html_report.page import (
    Axis,
    Chart,
    ConfigurationView,
    GridAxis,
    GridMap,
    KeyFigure,
    Mark,
    PageContents,
    PageWarning,
    Series,
    round_digits,
    tail_shares,
)
from diffdrive_mpc.bench.html_report.run_warnings import remedies
from diffdrive_mpc.bench.table import Table, millis, number
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc.mpc.config.described import commented_yaml
from diffdrive_mpc_extras.bootstrap import CONFIDENCE, TAIL, BootstrapEstimate, cvar, mean, median
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drive import TIME
from diffdrive_mpc_extras.campaign.engine import CampaignRun
from diffdrive_mpc_extras.campaign.rates import Rate
from diffdrive_mpc_extras.proof.proof_file import Boundary, DrivenMap, holds

CVAR = "CVaR 95 %"
UNSAFE = ("not_finite", "limit", "slew", "motion", "turn")
"""Kinds of unsafe commands, as `bench.campaign.command_check.Unsafe` names them."""
_BY_FACTOR = (
    "Braked: the robot braked or stood before the end, which is a false stop if all sensors are valid. Time behind: "
    "mean of the maximum of each run. Rates: mean RMS of the commands' change."
)
_DESCRIPTIONS = {
    "not_finite": "not finite",
    "limit": "above a limit",
    "slew": "above the slew or the braking limit",
    "motion": "motion for too long after a loss of poses",
    "turn": "below the minimum commanded radius",
}


@dataclass(frozen=True)
class Outcomes:
    """Rates of the outcomes of all runs."""

    completed: Rate
    in_band: Rate
    stopped: Rate
    unsafe: Rate

    @classmethod
    def of_runs(cls, driven: Sequence[CampaignRun], band: float) -> Outcomes:
        """Count the outcomes; `band` [m] as in `holds`."""
        count = len(driven)
        return cls(
            Rate.of_runs(sum(run.row["completed"] is True for run in driven), count),
            Rate.of_runs(sum(holds(run, band) for run in driven), count),
            Rate.of_runs(sum(map(_stopped, driven)), count),
            Rate.of_runs(sum(map(is_unsafe, driven)), count),
        )


def is_unsafe(run: CampaignRun) -> bool:
    """Return True if a run had an unsafe command."""
    return any(run.row.get(f"unsafe_{kind}") for kind in UNSAFE)


def errors(driven: Sequence[CampaignRun]) -> FloatArray:
    """Return the position RMSE [m] of all runs with a value; for an aborted run, over its simulated part."""
    return _known(driven, "position_rmse_m")


def error_estimates(driven: Sequence[CampaignRun]) -> dict[str, BootstrapEstimate]:
    """Estimate mean, median and CVaR of the position RMSE [m], of all runs and of completed runs."""
    completed = [run for run in driven if run.row["completed"] is True]
    statistics = {"mean": mean, "median": median, CVAR: cvar}
    return {
        f"{name}, {which}": BootstrapEstimate.of_runs(errors(runs), figure)
        for which, runs in (("all runs", driven), ("completed runs", completed))
        for name, figure in statistics.items()
    }


def worst(driven: Sequence[CampaignRun], count: int) -> list[CampaignRun]:
    """Return the `count` worst runs: unsafe, ended in an error, by position RMSE, and last those that stopped."""

    def badness(run: CampaignRun) -> tuple[bool, bool, bool, float]:
        error = run.number("position_rmse_m")
        return is_unsafe(run), run.row["error"] != "", not _stopped(run), error if math.isfinite(error) else math.inf

    return sorted(driven, key=badness, reverse=True)[:count]


def facts(driven: Sequence[CampaignRun], others: int) -> list[str]:
    """Summarise number and cost of the runs, and the bound on unsafe commands."""
    times = np.array([run.number(f"{TIME}processor_s") for run in driven])
    ticks = sum(run.number("steps") for run in driven if math.isfinite(run.number("steps")))
    failures = sum(run.row["error"] != "" for run in driven)
    unsafe = Rate.of_runs(sum(map(is_unsafe, driven)), len(driven))
    return [
        f"{len(driven)} runs drawn, {others} more for maps and boundaries; {ticks:.0f} ticks were checked.",
        f"Processor time of a run: mean {np.mean(times):.2f} s, 95th percentile {np.percentile(times, 95):.2f} s.",
        f"{unsafe.count} of {unsafe.of} runs had an unsafe command: "
        f"with {100 * CONFIDENCE:.0f} % confidence, the rate is below {percent(unsafe.bound)} %.",
        *([f"{failures} runs ended in an error and have no position error."] if failures else []),
    ]


def tables(
    driven: Sequence[CampaignRun],
    boundaries: Sequence[Boundary],
    files: Mapping[str, CampaignRun],
    seeds: int,
    band: float,
) -> list[Table]:
    """Build all tables; `files` are the worst runs by file name, `band` [m] as in `holds`."""
    result = [_rates(driven, band), _errors(driven), _unsafe(driven), *_by_factor(driven, band)]
    return [*result, *([_boundaries(boundaries, seeds)] if boundaries else []), _worst(files)]


def percent(share: float) -> str:
    """Format a share in percent with two significant digits."""
    return f"{100 * share:.2g}" if share < 0.1 else f"{100 * share:.1f}"


def _rates(driven: Sequence[CampaignRun], band: float) -> Table:
    rates = Outcomes.of_runs(driven, band)
    named = {
        "completed": rates.completed,
        "completed within the band": rates.in_band,
        "not completed: the controller stopped": rates.stopped,
        "with an unsafe command": rates.unsafe,
    }
    return Table.build(
        "Outcomes",
        ("runs",),
        {
            "count": lambda rate: f"{rate.count} of {rate.of}",
            "share [%]": lambda rate: number(100 * rate.share, 1),
            "95 % interval [%]": lambda rate: f"{100 * rate.low:.2f} to {100 * rate.high:.2f}",
        },
        [((name,), rate) for name, rate in named.items()],
        f"Intervals by Clopper and Pearson. The band is {1e3 * band:g} mm to either side of the path.",
    )


def _errors(driven: Sequence[CampaignRun]) -> Table:
    return Table.build(
        "Position error",
        ("figure",),
        {
            "position RMSE [mm]": lambda row: millis(row.value),
            "95 % interval [mm]": lambda row: f"{millis(row.low)} to {millis(row.high)}",
        },
        [((name,), estimate) for name, estimate in error_estimates(driven).items()],
        "CVaR 95 %: mean of the worst 5 % of the runs. Intervals: bootstrap, 2000 samples. For a stopped robot, the "
        "error grows as its reference continues.",
    )


def _unsafe(driven: Sequence[CampaignRun]) -> Table:
    def ticks(kind: str) -> int:
        return sum(int(run.row.get(f"unsafe_{kind}") or 0) for run in driven)

    def rate(kind: str) -> Rate:
        return Rate.of_runs(sum(bool(run.row.get(f"unsafe_{kind}")) for run in driven), len(driven))

    return Table.build(
        "Unsafe commands",
        ("command",),
        {
            "ticks": lambda kind: str(ticks(kind)),
            "runs": lambda kind: f"{rate(kind).count} of {rate(kind).of}",
            "upper bound of the rate [%]": lambda kind: percent(rate(kind).bound),
        },
        [((_DESCRIPTIONS[kind],), kind) for kind in UNSAFE],
        "Counted by an independent check. Upper bound: 95 % confidence; about 3/n for 0 of n runs.",
    )


def _by_factor(driven: Sequence[CampaignRun], band: float) -> list[Table]:
    """Build a table for each factor with few values, such as scenario and trajectory."""
    result = []
    for factor in ("scenario", "trajectory", "plant", "surface", "sensors"):
        groups: dict[str, list[CampaignRun]] = {}
        for run in driven:
            groups.setdefault(str(run.definition.columns[factor]), []).append(run)
        if 1 < len(groups) <= max(len(driven) / 2, 2):
            columns = {
                "runs": lambda runs: str(len(runs)),
                "completed": lambda runs: str(sum(run.row["completed"] is True for run in runs)),
                "in the band": lambda runs: str(sum(holds(run, band) for run in runs)),
                "braked": lambda runs: str(sum(run.row.get("stopped") is True for run in runs)),
                "time behind [s]": lambda runs: number(_mean(runs, "behind_max_s"), 2),
                "position RMSE, mean [mm]": lambda runs: millis(_or_nan(np.mean, errors(runs))),
                "maximum [mm]": lambda runs: millis(_or_nan(np.max, errors(runs))),
                "maximum lateral [mm]": lambda runs: millis(_max(runs, "lateral_max_m")),
                "v_ref rate [m/s^2]": lambda runs: number(_mean(runs, "recovery_command_rate_v"), 2),
                "omega_ref rate [rad/s^2]": lambda runs: number(_mean(runs, "recovery_command_rate_omega"), 2),
            }
            entries = [((name,), groups[name]) for name in sorted(groups)]
            result.append(Table.build(f"By {factor}", (factor,), columns, entries, _BY_FACTOR))
    return result


def _boundaries(boundaries: Sequence[Boundary], seeds: int) -> Table:
    def value(number_: float | None, row: Boundary) -> str:
        return "-" if number_ is None else f"{number_:.4g} {row.search.unit}".strip(" -")

    return Table.build(
        "Boundaries",
        ("factor",),
        {
            "passes at": lambda row: value(row.held, row),
            "fails at": lambda row: value(row.failed, row),
            "end of the search": lambda row: value(row.search.beyond, row),
            "tried values": lambda row: str(len(row.values)),
        },
        [((boundary.factor,), boundary) for boundary in boundaries],
        f"One factor at a time. A value passes if all {seeds} seeds complete within the band; bisection, assuming a "
        "monotone result.",
    )


def _worst(files: Mapping[str, CampaignRun]) -> Table:
    def message(run: CampaignRun) -> str:
        reason = run.row["error"] or run.row.get("ended") or run.row.get("message") or ""
        return str(reason)

    return Table.build(
        "Worst runs",
        ("file", "run"),
        {
            "completed": lambda row: "yes" if row.row["completed"] else "no",
            "position RMSE [mm]": lambda row: millis(row.number("position_rmse_m")),
            "maximum lateral [mm]": lambda row: millis(row.number("lateral_max_m")),
            "message": message,
        },
        [((name, _summary(file.definition)), file) for name, file in files.items()],
        "Each run is a file: `diffdrive-mpc repeat FILE` repeats it, with `--trust-terms FOLDER` for your files.",
    )


def _summary(definition: Definition) -> str:
    columns = definition.columns
    parts = [str(columns["trajectory"]), *([str(columns["scenario"])] if columns["scenario"] != "none" else [])]
    return ", ".join([*parts, f"seed {columns['seed']}"])


def _stopped(run: CampaignRun) -> bool:
    return run.row["completed"] is False and run.row.get("last_mode") in ("STOPPED", "BRAKING") and not run.row["ended"]


def _mean(driven: Sequence[CampaignRun], column: str) -> float:
    """Return the mean over the runs with a value."""
    return _or_nan(np.mean, _known(driven, column))


def _max(driven: Sequence[CampaignRun], column: str) -> float:
    return _or_nan(np.max, _known(driven, column))


def _known(driven: Sequence[CampaignRun], column: str) -> FloatArray:
    values = np.array([run.number(column) for run in driven])
    return np.asarray(values[np.isfinite(values)])


def _or_nan(figure: object, values: FloatArray) -> float:
    return float(figure(values)) if values.size else math.nan  # type: ignore[operator]


# Content of the HTML report: outcomes, errors, maps and boundaries.


_REPEAT_REMEDY = "repeat the worst run with `repeat worst/01.yaml --out worst/01`, and read its report"


def shown(config: str, driven: Sequence[CampaignRun], boundaries: Sequence[Boundary], band: float) -> PageContents:
    """Return summary, key figures and warnings of the page; `band` [m] as in `boundaries.holds`."""
    rates = Outcomes.of_runs(driven, band)
    return PageContents(
        summary=[
            f"{rates.completed.count} of {rates.completed.of} runs were completed, {rates.in_band.count} of them "
            f"within the band; {rates.unsafe.count or 'none'} had an unsafe command."
        ],
        key_figures=_key_figures(driven, rates),
        warnings=_warnings(driven, rates, boundaries, band),
        configurations=[ConfigurationView("Configuration under test (YAML)", commented_yaml(load_config(config)))],
    )


def _key_figures(driven: Sequence[CampaignRun], rates: Outcomes) -> list[KeyFigure]:
    tail = error_estimates(driven)[f"{CVAR}, completed runs"]
    bound = f"with 95 % confidence below {percent(rates.unsafe.bound)} %"
    return [
        KeyFigure("completed", f"{100 * rates.completed.share:.1f} %", _interval(rates.completed)),
        KeyFigure("completed within the band", f"{100 * rates.in_band.share:.1f} %", _interval(rates.in_band)),
        KeyFigure("stopped by the controller", f"{100 * rates.stopped.share:.1f} %", _interval(rates.stopped)),
        KeyFigure("unsafe commands", f"{rates.unsafe.count} runs", bound, "bad" if rates.unsafe.count else "good"),
        KeyFigure("position error, worst 5 %", f"{millis(tail.value)} mm", "CVaR 95 % of completed runs, RMSE"),
    ]


def _interval(rate: Rate) -> str:
    return f"{rate.count} of {rate.of}; 95 %: {100 * rate.low:.1f} to {100 * rate.high:.1f} %"


def tail_charts(driven: Sequence[CampaignRun]) -> list[Chart]:
    """Chart the share of completed runs with a larger error, and CVaR; empty if no run was completed."""
    rmse = 1e3 * errors([run for run in driven if run.row["completed"] is True])
    if not rmse.size:
        return []
    worst = 1e3 * error_estimates(driven)[f"{CVAR}, completed runs"].value
    series = Series("completed runs", *tail_shares(rmse), 0, "line")
    axes = Axis("position RMSE [mm]", "log"), Axis("share of completed runs with a larger error", "log")
    marks = [Mark(TAIL, f"{100 * TAIL:g} %"), Mark(round(worst, 2), f"{CVAR}: {worst:.1f} mm", upright=True)]
    return [Chart("Distribution of the error", *axes, [series], marks=marks)]


def map_chart(drawn: DrivenMap) -> GridMap:
    """Chart the position error over two factors."""
    x, y = drawn.axes.x, drawn.axes.y
    values = [[round_digits(1e3 * value) for value in row] for row in drawn.error]
    return GridMap(
        drawn.name.replace("-", " ").capitalize(),
        GridAxis(x.factor, x.values),
        GridAxis(y.factor, y.values),
        values,
        "position RMSE [mm]",
        (drawn.completed == 0.0).tolist(),
        "Colours are logarithmic; ×: the run was not completed.",
    )


def _warnings(
    driven: Sequence[CampaignRun], rates: Outcomes, boundaries: Sequence[Boundary], band: float
) -> list[PageWarning]:
    warnings = []
    failed = sum(run.row["error"] != "" for run in driven)
    if rates.unsafe.count:
        text = (
            f"{rates.unsafe.count} runs had an unsafe command: not finite, or outside the limits of the configuration."
        )
        warnings.append(PageWarning(text, f"do not use this configuration; {_REPEAT_REMEDY}, and report it"))
    if failed:
        warnings.append(PageWarning(f"{failed} runs ended in an error and count as not completed.", _REPEAT_REMEDY))
    if rates.stopped.count:
        text = f"In {rates.stopped.count} runs the controller stopped the robot safely before the end."
        warnings.append(PageWarning(text, f"find the scenarios in the tables; {remedies().waited}"))
    beyond = rates.completed.count - rates.in_band.count
    if beyond:
        text = f"{beyond} completed runs had a distance above {1e3 * band:g} mm from the path."
        warnings.append(PageWarning(text, f"keep more distance from obstacles, or drive slower; {_REPEAT_REMEDY}"))
    for boundary in boundaries:
        if boundary.held is None:
            text = f"{boundary.factor}: the value {boundary.search.holds:g} fails and should pass."
            warnings.append(PageWarning(text, "check the maps for other factors at their limits"))
    return warnings
