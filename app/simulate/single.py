"""Run a case, print a summary or tables, and write the report and the log."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from diffdrive_mpc.app.run_log import includes_plans, run_log
from diffdrive_mpc.bench.case import NO_MODEL, NO_SCENARIO, Case
from diffdrive_mpc.bench.controllers import build, case_config, other_robots, reference_remarks, select_model
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.report_folder import REPORT, page_in, staged
from diffdrive_mpc.bench.run_row import RunOutcome, driver_name
from diffdrive_mpc.bench.table import Table, duration
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.mpc.config.typed_settings import parse_single_settings
from diffdrive_mpc.mpc.problem.build import chosen_model as predicting_model
from diffdrive_mpc.mpc.trajectories.feasibility import find_shortfall
from diffdrive_mpc.mpc.trajectories.speed_check import describe_tight_turns
from diffdrive_mpc.sim import simulate
from diffdrive_mpc.sim.metrics.metrics import driven_share
from diffdrive_mpc.sim.plants.plug_ins import columns_of
from diffdrive_mpc.sim.run import NO_SOLVER

_MESSAGES_SHOWN = 5
_METHODS = {
    NO_SOLVER: "not solved",
    "unlimited": "no active limit",
    "active_set": "active set",
    "osqp": "OSQP",
    "daqp": "DAQP",
}
"""Descriptions of the solver's methods."""


def simulate_one(
    values: Mapping[str, Any],
    *,
    config: Path | None,
    settings: Sequence[str],
    out: Path | None,
    log: Path | None,
    scaled: bool = False,
    details: bool = False,
) -> None:
    """Run a case and print the result; on request write a report and a log.

    Parameters
    ----------
    values
        Values by dimension; `model` is None if the option was omitted.
    config, settings, out, log, scaled
        Options of the command, unchanged.
    details
        True to print the tables of the run instead of a summary.

    Raises
    ------
    ConfigError, ValueError, OSError
        Before the run, if a name, a file, a value or an output path cannot be used; nothing is written then.
    """
    case = case_from_options(values, config=config, settings=settings, scaled=scaled)
    controller, plant, reference = build(case)
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        folder = None if out is None else stack.enter_context(staged(out, (REPORT,), owner="simulate"))
        keep_plans = folder is not None or includes_plans(log)
        start = time.perf_counter()
        with ProgressBar("simulating") as bar:
            run = simulate(controller, plant, reference, on_tick=bar.show, keep_plans=keep_plans)
        write_log(run, case)
        if folder is not None:
            draw(RunOutcome(case, run), folder, time.perf_counter() - start)
    report(RunOutcome(case, run), out and page_in(out, "simulate"), details=details)


def case_from_options(values: Mapping[str, Any], *, config: Path | None, settings: Sequence[str], scaled: bool) -> Case:
    """Build the case from the options of the command; arguments and errors are those of `simulate_one`."""
    name, model = values["controller"], values["model"]
    if name in PEERS and (settings or config is not None or model is not None):
        raise ConfigError(f"the controller '{name}' does not accept --model, --config or --set")
    model = NO_MODEL if name in PEERS else select_model(model, config)
    file = None if config is None else str(config)
    return Case(**{**values, "model": model}, config=file, overrides=parse_single_settings(settings), scaled=scaled)


def report(outcome: RunOutcome, page: Path | None, *, details: bool = False) -> None:
    """Print a summary or the tables of a run, and the controller's messages; `page` is the report."""
    console = output_console()
    for line in _summary(outcome, page) if not details else ():
        console.print(line, markup=False, highlight=False)
    for table in tables(outcome) if details else ():
        console.print(table.rich())
    if outcome.case.controller not in PEERS:
        config = case_config(outcome.case)
        reference = outcome.run.reference
        shortfall = find_shortfall(reference, config, predicting_model(config, None))
        for remark in filter(None, (shortfall, describe_tight_turns(reference, config.limits, config.sample_time))):
            console.print(str(remark), markup=False, highlight=False)
    for sentence in (*other_robots([outcome.case]), *reference_remarks([outcome.case])):
        console.print(f"note: {sentence}", markup=False, highlight=False, soft_wrap=True)
    if details and outcome.run.ended:
        console.print(f"not completed: {outcome.run.ended}", markup=False, highlight=False)
    messages = [message for message in dict.fromkeys(outcome.run.messages) if message]
    for message in messages[:_MESSAGES_SHOWN]:
        console.print(f"controller: {message}", markup=False, highlight=False)
    if len(messages) > _MESSAGES_SHOWN:
        console.print(f"and {len(messages) - _MESSAGES_SHOWN} other messages", highlight=False)


def _summary(outcome: RunOutcome, page: Path | None) -> Iterator[str]:
    """Yield six lines, and one further line for a scenario and for each plug-in column of the run."""
    run, metrics, labels = outcome.run, outcome.run.metrics, outcome.case.labels
    if metrics.completed:
        driver = driver_name(outcome.case)
        yield f"completed: {driver} along {run.reference.name} on {labels['plant']}, {run.reference.duration:.1f} s"
    else:
        distance = run.errors.position[run.counted][-1]
        message = f"{distance:.3f} m from the reference at its end; {driven_share(run):.0%} driven"
        yield f"not completed: {run.ended or message}"
    yield "errors: " + "; ".join(
        f"{quantity} RMSE {1e3 * rmse:.1f} mm, max {1e3 * maximum:.1f} mm"
        for quantity, rmse, maximum in (
            ("position", metrics.position_rmse_m, metrics.position_max_m),
            ("lateral", metrics.lateral_rmse_m, metrics.lateral_max_m),
        )
    )
    times = metrics.step_time_p50_s, metrics.step_time_p99_s, metrics.step_time_max_s
    statistics = zip(("p50", "p99", "max"), times, strict=True)
    step_times = ", ".join(f"{name} {1e3 * time:.2f} ms" for name, time in statistics)
    yield f"step time: {step_times}; {metrics.deadline_misses} steps above {1e3 * run.sample_time:.1f} ms"
    ticks = Counter(itertools.compress(run.solver_methods, run.counted))
    shares = ", ".join(
        f"{_METHODS.get(name, name)} {100 * count / metrics.steps:.1f} %" for name, count in ticks.most_common()
    )
    yield f"solver: {'none' if set(ticks) == {NO_SOLVER} else shares}"
    late = f", {run.states.count('LATE')} LATE" if "LATE" in run.states else ""
    yield f"final mode: {run.modes[-1]}; {metrics.fallbacks} steps in a fallback mode{late}"
    if outcome.case.scenario != NO_SCENARIO:
        recovery = run.recovery
        yield f"recovery: {duration(recovery.recovery_time_s)} s, overshoot {1e3 * recovery.overshoot_m:.1f} mm"
    yield from filter(None, (part.summary(run) for part in columns_of(run)))
    if page is None:
        yield "next: --details prints the tables, --out FOLDER writes a report with figures"
    else:
        yield f"report: {page}; --details prints the tables"


def tables(outcome: RunOutcome) -> list[Table]:
    """Build the tables of a run."""
    from diffdrive_mpc.bench.comparison.tables import (  # noqa: PLC0415 - the summary does not need them
        error_table,
        path_table,
        scenario_table,
        summary_table,
    )
    from diffdrive_mpc.bench.experiment import frame  # noqa: PLC0415

    rows = frame([outcome.row])
    run_tables = [build_table(rows) for build_table in (summary_table, error_table, path_table)]
    if outcome.case.scenario != NO_SCENARIO:
        run_tables.append(scenario_table(rows))
    part_tables = (part.table(rows) for part in columns_of(outcome.run))
    return [*filter(None, part_tables), *run_tables]


def draw(outcome: RunOutcome, folder: Path, seconds: float) -> None:
    """Draw a run and its step times into `folder` and write the page; `seconds` is the wall-clock time of the run."""
    from diffdrive_mpc.app.simulate.single_page import single_page  # noqa: PLC0415
    from diffdrive_mpc.bench.html_report.document import write_page  # noqa: PLC0415 - only --out needs it

    draw_figures(outcome, folder)
    write_page(single_page(outcome, tables(outcome), seconds), folder / REPORT)


def draw_figures(outcome: RunOutcome, folder: Path) -> None:
    """Draw a run and its step times into `folder`."""
    from diffdrive_mpc.bench.chart_drawing import draw_charts  # noqa: PLC0415 - matplotlib loads slowly
    from diffdrive_mpc.bench.comparison.figures import draw_case  # noqa: PLC0415
    from diffdrive_mpc.bench.comparison.page import step_time_chart  # noqa: PLC0415
    from diffdrive_mpc.bench.experiment import frame  # noqa: PLC0415
    from diffdrive_mpc.bench.figure_style import file_name  # noqa: PLC0415

    title = f"{driver_name(outcome.case)}, {outcome.case.labels['trajectory']}"
    draw_case(outcome.run, f"{title}, seed {outcome.case.seed}", folder / f"{file_name(title)}.png")
    draw_charts([step_time_chart(frame([outcome.row]))], folder / f"{file_name(title)}-step-time.png")
