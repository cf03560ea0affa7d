"""The tables of a proof, and the sentences above them."""

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
    Series,
    Shown,
    Warned,
    rounded,
    tail,
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
    "Braked: it braked or stood on the way, a false stop where every sensor is honest. Time behind: largest "
    "of a run, mean. Rates: RMS of the commands' change, means."
)
_SAID = {
    "not_finite": "not finite",
    "limit": "beyond a limit",
    "slew": "beyond the slew or the braking limit",
    "motion": "motion longer than stated after poses have gone",
    "turn": "tighter than the least commanded radius",
}


@dataclass(frozen=True)
class Outcomes:
    """Rates of the outcomes of a proof's runs."""

    completed: Rate
    in_band: Rate
    stopped: Rate
    unsafe: Rate

    @classmethod
    def of_runs(cls, driven: Sequence[CampaignRun], band: float) -> Outcomes:
        """Count the outcomes; the band [m] is that of `boundaries.holds`."""
        count = len(driven)
        return cls(
            Rate.of_runs(sum(run.row["completed"] is True for run in driven), count),
            Rate.of_runs(sum(holds(run, band) for run in driven), count),
            Rate.of_runs(sum(map(_stopped, driven)), count),
            Rate.of_runs(sum(map(is_unsafe, driven)), count),
        )


def is_unsafe(run: CampaignRun) -> bool:
    """Check if a run had an unsafe command of any kind."""
    return any(run.row.get(f"unsafe_{kind}") for kind in UNSAFE)


def errors(driven: Sequence[CampaignRun]) -> FloatArray:
    """Return the position RMSE [m] of the runs that have one; for a run that ended early, of its driven part."""
    return _known(driven, "position_rmse_m")


def error_estimates(driven: Sequence[CampaignRun]) -> dict[str, BootstrapEstimate]:
    """Estimate mean, median and CVaR of the position RMSE [m], of all runs and of completed runs."""
    arrived = [run for run in driven if run.row["completed"] is True]
    named = {"mean": mean, "median": median, CVAR: cvar}
    return {
        f"{name}, {which}": BootstrapEstimate.of_runs(errors(runs), figure)
        for which, runs in (("all runs", driven), ("completed runs", arrived))
        for name, figure in named.items()
    }


def worst(driven: Sequence[CampaignRun], count: int) -> list[CampaignRun]:
    """Sort runs, worst first: unsafe, ended in an error, then by position RMSE; last those that stopped themselves."""

    def badness(run: CampaignRun) -> tuple[bool, bool, bool, float]:
        error = run.number("position_rmse_m")
        return is_unsafe(run), run.row["error"] != "", not _stopped(run), error if math.isfinite(error) else math.inf

    return sorted(driven, key=badness, reverse=True)[:count]


def facts(driven: Sequence[CampaignRun], others: int) -> list[str]:
    """Summarise the drives, their cost, and the bound on unsafe commands."""
    times = np.array([run.number(f"{TIME}processor_s") for run in driven])
    ticks = sum(run.number("steps") for run in driven if math.isfinite(run.number("steps")))
    failures = sum(run.row["error"] != "" for run in driven)
    unsafe = Rate.of_runs(sum(map(is_unsafe, driven)), len(driven))
    return [
        f"{len(driven)} runs drawn, {others} more for maps and boundaries; {ticks:.0f} ticks were checked.",
        f"Processor time of a run: mean {np.mean(times):.2f} s, 95th percentile {np.percentile(times, 95):.2f} s.",
        f"{unsafe.count} of {unsafe.of} runs had an unsafe command: "
        f"with {100 * CONFIDENCE:.0f} % confidence fewer than {percent(unsafe.bound)} % of all such runs have.",
        *([f"{failures} runs ended in an error; errors are those of the others."] if failures else []),
    ]


def tables(
    driven: Sequence[CampaignRun],
    boundaries: Sequence[Boundary],
    files: Mapping[str, CampaignRun],
    seeds: int,
    band: float,
) -> list[Table]:
    """Build all tables; `files` are the worst runs by file name, `band` [m] is that of `holds`."""
    made = [_rates(driven, band), _errors(driven), _unsafe(driven), *_by_factor(driven, band)]
    return [*made, *([_boundaries(boundaries, seeds)] if boundaries else []), _worst(files)]


def percent(share: float) -> str:
    """Format a share in percent with two leading digits."""
    return f"{100 * share:.2g}" if share < 0.1 else f"{100 * share:.1f}"


def _rates(driven: Sequence[CampaignRun], band: float) -> Table:
    rates = Outcomes.of_runs(driven, band)
    named = {
        "completed": rates.completed,
        "completed and never outside the band": rates.in_band,
        "not completed: it stopped by itself": rates.stopped,
        "with an unsafe command": rates.unsafe,
    }
    return Table.build(
        "How often",
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
        "CVaR 95 %: mean of the worst twentieth of the runs. Intervals: bootstrap, 2000 samples. A robot that stopped "
        "by itself counts with how far its reference has gone on.",
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
            "share of all runs, at most [%]": lambda kind: percent(rate(kind).bound),
        },
        [((_SAID[kind],), kind) for kind in UNSAFE],
        "Counted by a checker that shares no code with the controller. At most: 95 % confidence, one-sided; none of n "
        "runs means fewer than 3 in n.",
    )


def _by_factor(driven: Sequence[CampaignRun], band: float) -> list[Table]:
    """Build a table for each factor with a few named values, such as scenarios and paths."""
    made = []
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
                "worst [mm]": lambda runs: millis(_or_nan(np.max, errors(runs))),
                "largest lateral [mm]": lambda runs: millis(_largest(runs, "lateral_max_m")),
                "v_ref rate [m/s^2]": lambda runs: number(_mean(runs, "recovery_command_rate_v"), 2),
                "omega_ref rate [rad/s^2]": lambda runs: number(_mean(runs, "recovery_command_rate_omega"), 2),
            }
            entries = [((name,), groups[name]) for name in sorted(groups)]
            made.append(Table.build(f"By {factor}", (factor,), columns, entries, _BY_FACTOR))
    return made


def _boundaries(boundaries: Sequence[Boundary], seeds: int) -> Table:
    def value(number_: float | None, row: Boundary) -> str:
        return "-" if number_ is None else f"{number_:.4g} {row.search.unit}".strip(" -")

    return Table.build(
        "Boundaries",
        ("factor",),
        {
            "still holds at": lambda row: value(row.held, row),
            "no longer at": lambda row: value(row.failed, row),
            "searched to": lambda row: value(row.search.beyond, row),
            "values tried": lambda row: str(len(row.values)),
        },
        [((boundary.factor,), boundary) for boundary in boundaries],
        f"One factor at a time. It holds where {seeds} seeds all complete and never leave the band; by bisection, "
        "which takes everything between to be monotone.",
    )


def _worst(files: Mapping[str, CampaignRun]) -> Table:
    def words(run: CampaignRun) -> str:
        reason = run.row["error"] or run.row.get("ended") or run.row.get("message") or ""
        return str(reason)

    return Table.build(
        "Worst runs",
        ("file", "what it is"),
        {
            "completed": lambda row: "yes" if row.row["completed"] else "no",
            "position RMSE [mm]": lambda row: millis(row.number("position_rmse_m")),
            "largest lateral [mm]": lambda row: millis(row.number("lateral_max_m")),
            "what was said most": words,
        },
        [((name, _brief(file.definition)), file) for name, file in files.items()],
        "Each is a file: `diffdrive-mpc repeat FILE` drives it again; where it names files of yours, with "
        "`--trust-terms FOLDER`.",
    )


def _brief(definition: Definition) -> str:
    columns = definition.columns
    parts = [str(columns["trajectory"]), *([str(columns["scenario"])] if columns["scenario"] != "none" else [])]
    return ", ".join([*parts, f"seed {columns['seed']}"])


def _stopped(run: CampaignRun) -> bool:
    return run.row["completed"] is False and run.row.get("last_mode") in ("STOPPED", "BRAKING") and not run.row["ended"]


def _mean(driven: Sequence[CampaignRun], column: str) -> float:
    """Average the runs that have a value."""
    return _or_nan(np.mean, _known(driven, column))


def _largest(driven: Sequence[CampaignRun], column: str) -> float:
    return _or_nan(np.max, _known(driven, column))


def _known(driven: Sequence[CampaignRun], column: str) -> FloatArray:
    values = np.array([run.number(column) for run in driven])
    return np.asarray(values[np.isfinite(values)])


def _or_nan(figure: object, values: FloatArray) -> float:
    return float(figure(values)) if values.size else math.nan  # type: ignore[operator]


# What the page of a proof shows: how often it went how, errors of all runs, maps, and where factors stop to hold.


_WORDS_AGAIN = "drive the worst again with `repeat worst/01.yaml --out worst/01`, and read its report"


def shown(config: str, driven: Sequence[CampaignRun], boundaries: Sequence[Boundary], band: float) -> Shown:
    """Return summary, key figures and warnings of the page; `band` [m] as in `boundaries.holds`."""
    rates = Outcomes.of_runs(driven, band)
    return Shown(
        summary=[
            f"{rates.completed.count} of {rates.completed.of} runs came to their end, {rates.in_band.count} of them "
            f"never outside the band; {rates.unsafe.count or 'none'} had an unsafe command."
        ],
        key_figures=_key_figures(driven, rates),
        warnings=_warnings(driven, rates, boundaries, band),
        configurations=[ConfigurationView("Configuration that was proven (YAML)", commented_yaml(load_config(config)))],
    )


def _key_figures(driven: Sequence[CampaignRun], rates: Outcomes) -> list[KeyFigure]:
    tail = error_estimates(driven)[f"{CVAR}, completed runs"]
    bound = f"with 95 % confidence fewer than {percent(rates.unsafe.bound)} %"
    return [
        KeyFigure("completed", f"{100 * rates.completed.share:.1f} %", _interval(rates.completed)),
        KeyFigure("completed inside the band", f"{100 * rates.in_band.share:.1f} %", _interval(rates.in_band)),
        KeyFigure("stopped by itself", f"{100 * rates.stopped.share:.1f} %", _interval(rates.stopped)),
        KeyFigure("unsafe commands", f"{rates.unsafe.count} runs", bound, "bad" if rates.unsafe.count else "good"),
        KeyFigure("position error, worst twentieth", f"{millis(tail.value)} mm", "CVaR 95 % of completed runs, RMSE"),
    ]


def _interval(rate: Rate) -> str:
    return f"{rate.count} of {rate.of}; 95 %: {100 * rate.low:.1f} to {100 * rate.high:.1f} %"


def tail_charts(driven: Sequence[CampaignRun]) -> list[Chart]:
    """Chart the share of completed runs with a larger error, and CVaR; empty without such runs."""
    rmse = 1e3 * errors([run for run in driven if run.row["completed"] is True])
    if not rmse.size:
        return []
    worst = 1e3 * error_estimates(driven)[f"{CVAR}, completed runs"].value
    series = Series("completed runs", *tail(rmse), 0, "line")
    axes = Axis("position RMSE [mm]", "log"), Axis("share of completed runs with more", "log")
    marks = [Mark(TAIL, f"{100 * TAIL:g} %"), Mark(round(worst, 2), f"{CVAR}: {worst:.1f} mm", upright=True)]
    return [Chart("How large the error is", *axes, [series], marks=marks)]


def map_chart(drawn: DrivenMap) -> GridMap:
    """Chart the position error by two factors."""
    x, y = drawn.axes.x, drawn.axes.y
    values = [[rounded(1e3 * value) for value in row] for row in drawn.error]
    return GridMap(
        drawn.name.replace("-", " ").capitalize(),
        GridAxis(x.factor, x.values),
        GridAxis(y.factor, y.values),
        values,
        "position RMSE [mm]",
        (drawn.completed == 0.0).tolist(),
        "Colours are logarithmic; ×: the run did not come to its end.",
    )


def _warnings(
    driven: Sequence[CampaignRun], rates: Outcomes, boundaries: Sequence[Boundary], band: float
) -> list[Warned]:
    warnings = []
    failed = sum(run.row["error"] != "" for run in driven)
    if rates.unsafe.count:
        words = f"{rates.unsafe.count} runs had an unsafe command: not finite, or beyond what the configuration allows."
        warnings.append(Warned(words, f"do not drive with it; {_WORDS_AGAIN}, and send it to the authors"))
    if failed:
        warnings.append(Warned(f"{failed} runs ended in an error and count as not completed.", _WORDS_AGAIN))
    if rates.stopped.count:
        words = f"In {rates.stopped.count} runs the robot stopped by itself: safe, but not at its end."
        warnings.append(Warned(words, f"look in the tables which scenario that is; {remedies().waited}"))
    beyond = rates.completed.count - rates.in_band.count
    if beyond:
        words = f"{beyond} completed runs were further than {1e3 * band:g} mm from the path at some time."
        warnings.append(Warned(words, f"leave that much room beside the path, or drive slower; {_WORDS_AGAIN}"))
    for boundary in boundaries:
        if boundary.held is None:
            words = f"{boundary.factor}: not even {boundary.search.holds:g} holds, which should."
            warnings.append(Warned(words, "look at the maps for what else is at its limit there"))
    return warnings
