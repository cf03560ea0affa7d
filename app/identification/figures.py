"""Figures and charts of an identification."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.chart_drawing import draw_chart, draw_charts
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Mark, Series, from_zero, round_digits
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.identification.deliver.report import IdentificationReport
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS

FOLDER = "figures"
"""Name of the folder of figures in the folder of results."""
UNITS = {"v": "m/s", "omega": "rad/s"}
WINDOW = 30.0
"""Duration of validation data in each row of a figure with at most `_MAX_ROWS` rows [s]."""
_MAX_ROWS = 6
_STEP_DURATION = 5.0
"""Duration of a step response, relative to the lag of the slower channel [-]."""
_SAMPLES, _POINTS = 400, 1500
"""Number of samples of a step response, and approximate number of points of a series."""
_INTERVAL_HALF_WIDTH = 1.959964
"""Half-width of a 95 % interval in standard deviations."""

Draw = Callable[[IdentificationReport, Path], None]


def draw_identification(report: IdentificationReport, folder: Path, on_done: Callable[[], None]) -> dict[str, str]:
    """Draw the figures into the subfolder `FOLDER` of `folder`; call `on_done` after each figure.

    Returns
    -------
    dict
        Path of each file relative to `folder`, by title, in display order.
    """
    (folder / FOLDER).mkdir()
    paths = {}
    for title, (name, figure) in figures_of(report).items():
        paths[title] = f"{FOLDER}/{name}"
        if callable(figure):
            figure(report, folder / paths[title])
        else:
            draw_charts(figure, folder / paths[title])
        on_done()
    return paths


def figures_of(report: IdentificationReport) -> dict[str, tuple[str, Draw | Sequence[Chart]]]:
    """Return the figures for which the report has data, by title, each as file name and charts or drawing function."""
    figures: dict[str, tuple[str, Draw | Sequence[Chart]]] = {
        "Measured and simulated": ("simulation.png", draw_simulation),
        "Correlation of residuals": ("residuals.png", draw_residuals),
    }
    if report.fitted.predictor is None:
        figures |= {"Step responses": ("steps.png", step_charts(report)), "Poles": ("poles.png", draw_poles)}
    if report.fitted.orders:
        figures["Orders of SSM"] = ("orders.png", order_charts(report))
    if report.poses.drift:
        figures["Drift of the pose"] = ("drift.png", drift_charts(report))
    return figures


def other_charts(report: IdentificationReport) -> list[Chart]:
    """Return the charts of step responses, orders and drift, if available."""
    return [chart for _, figure in figures_of(report).values() if not callable(figure) for chart in figure]


def simulation_charts(report: IdentificationReport, points: int = _POINTS) -> list[Chart]:
    """Return a chart for each channel with command, measurement and simulation of all validation data.

    Records follow each other in time. Each series is reduced to about `points` points, which preserve the extremes.
    """
    data, fitted, records = report.data, report.fitted, report.data.validation
    time_title = "time in validation data [s], records in sequence"
    starts = np.cumsum([0.0, *(record.dt * len(record.command) for record in records)])
    if len(records) == 1:
        time_title = from_zero(records[0].time)[1]
    columns: list[list[FloatArray]] = [[], [], []]
    experiments = twist_experiments(records, data.yaw)
    for record, experiment, simulated, start in zip(records, experiments, fitted.simulated, starts, strict=False):
        time = start + record.dt * np.arange(len(record.command))
        for column, values in zip(columns, (record.command, experiment.readings, simulated), strict=True):
            # NaN interrupts the line at the end of each record.
            column.append(np.vstack([np.column_stack([time, values]), [time[-1], np.nan, np.nan]]))
    charts = []
    for i, channel in enumerate(CHANNELS):
        series = []
        for name, column, style in zip(("command", "measured", "simulated"), columns, (6, 0, 1), strict=True):
            rows = np.vstack(column)[:, [0, 1 + i]]
            if name == "measured":  # points need no gaps between records
                rows = rows[np.isfinite(rows[:, 1])]
            time, values = rows[envelope(rows[:, 1], points)].T
            x, y = [round(float(value), 3) for value in time], [round_digits(value) for value in values]
            series.append(Series(name, x, y, style, "points" if style == 0 else "line"))
        fit = number(float(fitted.validation.fit_percent[i]), 1)
        note = f"All validation data, simulated from the commands only. FIT {fit} %."
        axis, title = Axis(f"{channel} [{UNITS[channel]}]"), f"{channel}: measured and simulated, FIT {fit} %"
        charts.append(Chart(title, Axis(time_title), axis, series, note, broad=True))
    return charts


def envelope(values: FloatArray, points: int) -> NDArray[np.intp]:
    """Select about `points` rows that preserve the shape of `values` (n,): the extremes of each bin, and all NaN."""
    finite = np.flatnonzero(np.isfinite(values))
    size = 1 if len(finite) <= points else -(-2 * len(finite) // points)
    bins = np.split(finite, np.arange(size, len(finite), size))
    bins = [rows for rows in bins if len(rows)]
    extremes = [rows[index(values[rows])] for rows in bins for index in (np.argmin, np.argmax)]
    return np.union1d(np.array(extremes, dtype=np.intp), np.flatnonzero(np.isnan(values)))


def draw_simulation(report: IdentificationReport, path: Path) -> None:
    """Draw all validation data in consecutive rows, with one column for v and one for omega."""
    records = report.data.validation
    total = sum(record.dt * len(record.command) for record in records)
    rows = min(_MAX_ROWS, max(1, int(np.ceil(total / WINDOW))))
    charts = simulation_charts(report, rows * _POINTS)
    with new_figure(path, 4.6 * len(charts), 1.2 + 1.8 * rows) as figure:
        panels = figure.subplots(rows, len(charts), squeeze=False, sharey="col")
        for column, chart in zip(panels.T, charts, strict=True):
            for k, axes in enumerate(column):
                draw_chart(axes, chart)
                axes.set_xlim(k * total / rows, (k + 1) * total / rows)
                axes.set_xlabel(chart.x.title if k == rows - 1 else "")
            column[0].set_title(chart.title)
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def step_charts(report: IdentificationReport) -> list[Chart]:
    """Return a chart for each command with the responses of both outputs to a unit step, including dead time."""
    model = report.fitted.identified.model
    time, responses = step_responses(report)
    x, charts = [round(float(value), 4) for value in time], []
    for j, command in enumerate(CHANNELS):
        series = [
            Series(f"{channel} [{UNITS[channel]}]", x, [round_digits(value) for value in responses[j][:, i]], i, "line")
            for i, channel in enumerate(CHANNELS)
        ]
        gains = ", ".join(f"{channel} {model.dc_gain[i, j]:.3f}" for i, channel in enumerate(CHANNELS))
        note = f"Dead time {1e3 * model.dead_time[j]:.0f} ms; steady state {gains}."
        marks = [Mark(1.0, ""), Mark(float(model.dead_time[j]), "dead time", upright=True)]
        title = f"Step of {command}_ref by 1 {UNITS[command]}"
        charts.append(Chart(title, Axis("time [s]"), Axis("response"), series, note, marks))
    return charts


def order_charts(report: IdentificationReport) -> list[Chart]:
    """Return a chart of training and validation FIT over the order for each channel."""
    choice = report.fitted.orders
    assert choice is not None
    orders, charts = list(range(1, len(choice.rows) + 1)), []
    for i, channel in enumerate(CHANNELS):
        attributes = {"training": "train_fit_percent", "validation": "validation_fit_percent"}
        series = [
            Series(label, orders, [round_digits(getattr(row, name)[i]) for row in choice.rows], k)
            for k, (label, name) in enumerate(attributes.items())
        ]
        marks = [Mark(choice.order, "selected", upright=True)]
        charts.append(Chart(f"Comparison of orders, {channel}", Axis("order"), Axis("FIT [%]"), series, "", marks))
    return charts


def drift_charts(report: IdentificationReport) -> list[Chart]:
    """Return the chart of the position error over the prediction horizon."""
    drift = report.poses.drift
    x = [row.horizon for row in drift]
    series = [
        Series("RMSE", x, [round_digits(row.position_rmse) for row in drift], 0),
        Series("mean", x, [round_digits(row.position_mean) for row in drift], 1),
    ]
    axes = Axis("time since the start of the prediction [s]"), Axis("position error [m]")
    return [Chart("Drift of the pose", *axes, series)]


def draw_residuals(report: IdentificationReport, path: Path) -> None:
    """Draw the autocorrelations of both residuals and their correlations with the commands, with 95 % bounds."""
    residuals = report.fitted.validation.residuals
    lags = residuals.lag_step * np.arange(residuals.autocorrelation.shape[1])
    two_sided_lags = residuals.lag_step * (np.arange(residuals.cross_correlation.shape[2]) - len(lags) + 1)
    with new_figure(path, 7.4, 6.0) as figure:
        panels = figure.subplots(2, 3, width_ratios=(1.0, 1.3, 1.3))
        for i, channel in enumerate(CHANNELS):
            panel = panels[i, 0]
            bound = residuals.whiteness_bound
            panel.axhspan(-bound, bound, color=REFERENCE_COLOUR, alpha=0.3, linewidth=0)
            panel.plot(lags, residuals.autocorrelation[i], color=colour(i))
            panel.set(xlabel="lag [s]", ylabel=f"residual of {channel}", title="autocorrelation")
            for j, command in enumerate(CHANNELS):
                axes = panels[i, 1 + j]
                bound = residuals.cross_bound[i, j]
                axes.axhspan(-bound, bound, color=REFERENCE_COLOUR, alpha=0.3, linewidth=0, label="95 % bound")
                axes.plot(two_sided_lags, residuals.cross_correlation[i, j], color=colour(i))
                axes.axvline(0.0, color="black", linewidth=0.6)
                height = 1.15 * max(2.0 * bound, float(np.abs(residuals.cross_correlation[i, j]).max()))
                axes.set(xlabel="lead of the command [s]", title=f"with {command}_ref", ylim=(-height, height))
        panels[0, 1].legend(loc="upper left")
        figure.suptitle(f"{report.name}: correlation of validation residuals; grey: 95 % bounds of white residuals")


def step_responses(report: IdentificationReport) -> tuple[FloatArray, list[FloatArray]]:
    """Compute times (n,) [s], and the outputs (n, 2) after a unit step of each command."""
    model = report.fitted.identified.model
    discrete = model.discretise(_STEP_DURATION * float(model.lag.max()) / _SAMPLES)
    time = discrete.dt * np.arange(_SAMPLES + 1)
    return np.asarray(time), [discrete.simulate(np.tile(np.eye(2)[j], (len(time), 1))) for j in range(2)]


_LOG_SCALE_RATIO = 8.0
"""Ratio of fastest to slowest pole above which the axis is logarithmic, so that slow poles can be distinguished."""


def draw_poles(report: IdentificationReport, path: Path) -> None:
    """Draw the poles with their values and, if known, 95 % intervals; if all poles are real, each has its own row."""
    identified = report.fitted.identified
    poles = np.sort_complex(identified.model.poles)
    all_real = not poles.imag.any()

    def height_of(pole: complex) -> float:
        # The intervals of real poles would overlap in one row.
        return -float(np.argmin(np.abs(poles.real - pole.real))) if all_real else pole.imag

    with new_figure(path, 5.6, 4.2) as figure:
        axes = figure.add_subplot()
        for real, imag, real_deviation, imag_deviation in _uncertain_poles(identified):
            for sign in (1.0, -1.0) if imag else (1.0,):
                axes.errorbar(
                    real,
                    height_of(complex(real, sign * imag)),
                    xerr=_INTERVAL_HALF_WIDTH * real_deviation,
                    yerr=_INTERVAL_HALF_WIDTH * imag_deviation if imag else None,
                    color=colour(1),
                    capsize=2.5,
                    linewidth=1.0,
                )
        for pole in poles:
            axes.plot(pole.real, height_of(pole), "x", color=colour(0), markersize=8, markeredgewidth=1.8)
            value = f"{pole.real:.3g}{pole.imag:+.3g}j" if pole.imag else f"{pole.real:.3g}"
            axes.annotate(value, (pole.real, height_of(pole)), (0, 7), textcoords="offset points", ha="center")
        # Choose the scale by the poles, because an interval may be infinite.
        maximum = float(np.abs(poles).max())
        minimum = float(np.abs(poles.real[poles.real != 0.0]).min(initial=maximum))
        if maximum > _LOG_SCALE_RATIO * minimum:
            axes.set_xscale("symlog", linthresh=0.5 * minimum)
            axes.set_xlim(-3.0 * maximum, 0.0)
        else:
            axes.set_xlim(-1.4 * maximum, 0.05 * maximum)
        if all_real:
            axes.set_yticks([])
            axes.set(ylim=(-len(poles), 1.0), ylabel="real poles, fastest at the top")
        else:
            axes.axhline(0.0, color="black", linewidth=0.6)
            height = max(maximum / 3, 1.4 * float(np.abs(poles.imag).max()))
            axes.set(ylim=(-height, height), ylabel="imaginary part [rad/s]")
        axes.set(xlabel="real part [rad/s]", title=f"{report.name}: poles with 95 % intervals")


def _uncertain_poles(identified: IdentifiedModel) -> list[tuple[float, float, float, float]]:
    """Return real and imaginary part and their standard deviations [rad/s] of each pole with known uncertainty."""
    rows = []
    for poles in identified.poles:
        for name in poles.names:
            pole, _, component = name.partition(".")
            if component == "real":
                imag = f"{pole}.imag"
                rows.append((poles.value(name), poles.value(imag), poles.deviation(name), poles.deviation(imag)))
            elif not component:
                rows.append((poles.value(name), 0.0, poles.deviation(name), 0.0))
    return rows
