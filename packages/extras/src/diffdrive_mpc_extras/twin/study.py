"""Study `diffdrive-mpc twin`: fit a plant to logs, and write plant file, report, data and figure."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from joblib import Parallel, delayed

from diffdrive_mpc.app.identification.figures import WINDOW
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.page import from_zero
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.log_data import OptionError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.logs import Finding
from diffdrive_mpc.models.logs.record import format_findings
from diffdrive_mpc.models.structures.identified import round_values
from diffdrive_mpc_extras.twin.free_run import FreeMotion
from diffdrive_mpc_extras.twin.from_log import FittedTwin, fit_twin_to_logs
from diffdrive_mpc_extras.twin.held_out import HeldOutScore
from diffdrive_mpc_extras.twin.problem import Task, run_sequentially
from diffdrive_mpc_extras.twin.settings import twin_settings

PLANT = "plant.yaml"
_HEAD = """\
# A plant fitted to a log, for `--plant mujoco:plant.yaml`. SI units; keys as in sim/plants/parameters and
# models/parameters/robot.yaml. `friction` and `sensors` are the defaults of this plant; --surface and --sensors replace
# them. firmware.provenance contains the fitted parameters, their intervals, and whether the log determines them (told).
"""


def plant_text(twin: FittedTwin, day: datetime.date) -> str:
    """Format the plant file."""
    robot = twin.fit.robot
    data: dict[str, Any] = robot.model_dump(exclude_none=True)
    data["firmware"]["provenance"] = {
        "source": ", ".join(twin.data.logs),
        "method": "least squares of free runs of the plant, from commands alone, with priors (diffdrive-mpc twin)",
        "date": day.isoformat(),
        "seconds_fitted": round(twin.fit.seconds, 1),
        "held_out_fit_percent": {name: round(value, 2) for name, value in twin.twin_score.fit_percent.items()},
        "parameters": {
            parameter.name: round_values({"value": parameter.value, "low": parameter.low, "high": parameter.high})
            | {"told": parameter.told}
            for parameter in twin.fit.parameters
        },
    }
    content = _round_numbers(data)
    return _HEAD + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)


def _round_numbers(value: Any) -> Any:  # noqa: ANN401 - nested data
    """Round all numbers of nested data to the digits of the plant file."""
    if isinstance(value, Mapping):
        return {key: _round_numbers(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_round_numbers(entry) for entry in value]
    if isinstance(value, float):
        return round_values(value)
    return value


def fit_table(twin: FittedTwin) -> Table:
    """Tabulate FIT and drift of the twin and of the identified model on the held-out rows."""
    names = list(dict.fromkeys([*twin.model_score.fit_percent, *twin.twin_score.fit_percent]))
    horizons = [drift.horizon for drift in twin.twin_score.drift]
    rows = []
    for name, score in (("twin", twin.twin_score), (twin.model_name, twin.model_score)):
        cells = [f"{score.fit_percent[key]:.1f}" if key in score.fit_percent else "-" for key in names]
        cells += [f"{drift.position_rmse:.3f}" for drift in score.drift]
        cells += [f"{drift.heading_rmse:.3f}" for drift in score.drift]
        rows.append((name, *cells))
    columns = ["", *(f"FIT {name} [%]" for name in names)]
    columns += [f"position {horizon:g} s [m]" for horizon in horizons] + [
        f"heading {horizon:g} s [rad]" for horizon in horizons
    ]
    note = f"Free runs from the commands alone, on {twin.data.held_out}. Pose errors are RMS."
    return Table("Held-out rows", tuple(columns), tuple(rows), note=note)


def parameter_table(twin: FittedTwin) -> Table:
    """Tabulate the fitted parameters with their intervals."""
    rows = tuple(
        (
            parameter.name,
            parameter.words,
            parameter.unit,
            f"{parameter.value:.4g}",
            f"{parameter.low:.4g} to {parameter.high:.4g}",
            f"{parameter.share:.2f}",
            "yes" if parameter.told else "no, prior",
        )
        for parameter in twin.fit.parameters
    )
    columns = ("parameter", "description", "unit", "value", "95 % interval", "deviation / prior", "determined")
    note = (
        f"Not determined: the posterior has at least {twin_settings().told:g} of the width of the prior; the plant "
        "keeps the median of the prior, and the table shows the interval of the prior. If a log determines only a "
        "combination of two parameters (mass, torque), one may count as determined, given the prior of the second."
    )
    return Table("Parameters", columns, rows, text_columns=3, note=note)


def scores_and_parameters(twin: FittedTwin) -> dict[str, Any]:
    """Return the scores and the parameters as the content of `twin.json`."""
    keys = ("horizon", "position_rmse", "heading_rmse")

    def plain_score(score: HeldOutScore) -> dict[str, Any]:
        return {
            "fit_percent": dict(score.fit_percent),
            "drift": [{key: getattr(drift, key) for key in keys} for drift in score.drift],
        }

    parameters = [asdict(parameter) for parameter in twin.fit.parameters]
    return {"twin": plain_score(twin.twin_score), "model": plain_score(twin.model_score), "parameters": parameters}


_UNITS = {"v": "m/s", "omega": "rad/s"}


def draw_held_out(twin: FittedTwin, path: Path) -> None:
    """Draw measurement, twin and identified model in the most active window of the longest held-out section."""
    longest = int(np.argmax([run.samples for run in twin.experiments]))
    run, record = twin.experiments[longest], twin.data.validation[longest]
    window = round(WINDOW / run.dt)
    first = _most_active_window(run.inputs, window)
    rows = slice(first, first + window)
    time, time_label = from_zero(record.time[rows])
    with new_figure(path, 7.4, 5.2) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for panel, (i, (channel, unit)) in zip(panels, enumerate(_UNITS.items()), strict=True):
            counts = run.counts[rows, -i]
            panel.step(time, run.inputs[rows, i], where="post", color=REFERENCE_COLOUR, linewidth=0.9, label="command")
            panel.plot(
                time[counts], run.outputs[rows, -i][counts], ".", markersize=2.5, color=colour(0), label="measured"
            )
            for k, (name, score) in enumerate((("twin", twin.twin_score), ("identified model", twin.model_score))):
                fit = score.fit_percent[channel]
                values = score.predictions[longest].readings[rows, -i]
                panel.plot(time, values, line_style(k), color=colour(k + 1), label=f"{name}: FIT {fit:.1f} %")
            panel.set_ylabel(f"{channel} [{unit}]")
            panel.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels[-1].set_xlabel(time_label)
        figure.align_ylabels(panels)


def _most_active_window(commands: FloatArray, window: int) -> int:
    """Return the first row of the window with the largest sum of command changes, each divided by its range."""
    if len(commands) <= window:
        return 0
    change = np.abs(np.diff(commands, axis=0, prepend=commands[:1]))
    activity = np.cumsum((change / np.maximum(np.ptp(commands, axis=0), np.finfo(float).tiny)).sum(axis=1))
    return int(np.argmax(activity[window - 1 :] - np.concatenate([[0.0], activity[:-window]])))


class TwinStudy(Study[None, FittedTwin]):
    """Fit of a plant to logs; `logs` and `options` as in `fit_twin_to_logs`."""

    name = "twin"
    title = "A plant fitted to a log"

    def __init__(self, logs: Sequence[Path], **options: Any) -> None:  # noqa: ANN401 - of `fit_twin_to_logs`
        self._logs, self._options = logs, options

    def plan(self) -> None:
        """Return None; `run` reads the logs."""

    def run(self, plan: None, jobs: int, bar: ProgressBar) -> FittedTwin:
        """Fit the plant; raises ConfigError, ValueError or OSError if an option or a log is invalid."""
        del plan
        bar.start_stage("reading", 1)
        with Parallel(n_jobs=jobs) as pool:

            def parallel(tasks: Sequence[Task]) -> list[list[FreeMotion] | None]:
                return list(pool(delayed(_call)(task) for task in tasks))

            try:
                return fit_twin_to_logs(
                    self._logs,
                    run_tasks=run_sequentially if jobs == 1 else parallel,
                    on_stage=bar.start_stage,
                    on_drive=bar.advance,
                    on_findings=_print_findings,
                    **self._options,
                )
            except OptionError as error:
                raise ConfigError(f"--{error.option.replace('_', '-')}{error.rest}") from error

    def report(self, results: FittedTwin, seconds: float) -> Report:
        """Return scores, parameters, the plant file, and the figure of the held-out rows."""
        del seconds
        undetermined = [parameter.name for parameter in results.fit.parameters if not parameter.told]
        note = f"The log does not determine {', '.join(undetermined)}: prior kept." if undetermined else ""
        return Report(
            size=f"{results.fit.drives} drives of the plant",
            meta={"logs": list(results.data.logs), "robot": results.name, "model": results.model_name},
            content=scores_and_parameters(results),
            facts=[
                f"{results.name}: fitted to {results.fit.seconds:.0f} s of {', '.join(results.data.logs)}, the windows "
                f"with the largest command changes. {note}",
                f"Next: `diffdrive-mpc simulate --plant mujoco:{PLANT} --trajectory square`.",
            ],
            notes=results.notes,
            tables=[fit_table(results), parameter_table(results)],
            figures={"held_out.png": partial(draw_held_out, results)},
            files={PLANT: plant_text(results, datetime.date.today())},
        )


def _call(task: Task) -> list[FreeMotion] | None:
    return task()


def _print_findings(findings: Sequence[Finding]) -> None:
    for line in format_findings(findings):
        output_console().print(f"note: {line}", markup=False, highlight=False, soft_wrap=True)
