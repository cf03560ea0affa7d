"""The figures of an identification."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.chart_drawing import draw_chart, draw_charts
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Mark, Series, from_zero, rounded
from diffdrive_mpc.bench.table import number
from diffdrive_mpc.models.identification.deliver.report import IdentificationReport
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS

FOLDER = "figures"
"""Name of the folder of figures inside that of the results."""
UNITS = {"v": "m/s", "omega": "rad/s"}
WINDOW = 30.0
"""Duration of a drive that a row of a figure shows, while there are at most `_ROWS` [s]."""
_ROWS = 6
_STEP_RESPONSE = 5.0
"""Duration of a step response over the lag of the slower channel [-]."""
_SAMPLES, _POINTS = 400, 1500
_INTERVAL = 1.959964

Draw = Callable[[IdentificationReport, Path], None]


def draw_identification(report: IdentificationReport, folder: Path, on_done: Callable[[], None]) -> dict[str, str]:
    """Draw the figures into `FOLDER` inside `folder`; `on_done` is called after each.

    Returns
    -------
    dict
        Title and path of each file, relative to `folder`, in the order to be shown.
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
    """Return title, file name and charts or drawing function of each figure with data in the report."""
    jobs: dict[str, tuple[str, Draw | Sequence[Chart]]] = {
        "Measured against simulated": ("simulation.png", draw_simulation),
        "What residuals still hold": ("residuals.png", draw_residuals),
    }
    if report.fitted.predictor is None:
        jobs |= {"Step responses": ("steps.png", step_charts(report)), "Poles": ("poles.png", draw_poles)}
    if report.fitted.orders:
        jobs["Orders of SSM"] = ("orders.png", order_charts(report))
    if report.poses.drift:
        jobs["Drift of the pose"] = ("drift.png", drift_charts(report))
    return jobs


def other_charts(report: IdentificationReport) -> list[Chart]:
    """Step responses, orders and drift where there are any."""
    steps = step_charts(report) if report.fitted.predictor is None else []
    orders = order_charts(report) if report.fitted.orders else []
    return [*steps, *orders, *(drift_charts(report) if report.poses.drift else [])]


def simulation_charts(report: IdentificationReport, points: int = _POINTS) -> list[Chart]:
    """Chart command, measurement and simulation of both channels on all held-out data, thinned to `points` each.

    Stretches are in sequence. The minimum and the maximum of the rows behind each point stay.
    """
    data, fitted = report.data, report.fitted
    records = data.validation
    when = "time held out [s], stretches one after another"
    begins = np.cumsum([0.0, *(record.dt * len(record.command) for record in records)])
    if len(records) == 1:
        when = from_zero(records[0].time)[1]
    columns: list[list[FloatArray]] = [[], [], []]
    experiments = twist_experiments(records, data.yaw)
    for record, experiment, simulated, start in zip(records, experiments, fitted.simulated, begins, strict=False):
        time = start + record.dt * np.arange(len(record.command))
        for column, values in zip(columns, (record.command, experiment.readings, simulated), strict=True):
            # A line ends where its stretch does.
            column.append(np.vstack([np.column_stack([time, values]), [time[-1], np.nan, np.nan]]))
    made = []
    for i, channel in enumerate(CHANNELS):
        series = []
        for name, column, style in zip(("command", "measured", "simulated"), columns, (6, 0, 1), strict=True):
            rows = np.vstack(column)[:, [0, 1 + i]]
            if name == "measured":  # points, which no gap separates
                rows = rows[np.isfinite(rows[:, 1])]
            time, values = rows[envelope(rows[:, 1], points)].T
            times = [round(float(value), 3) for value in time]
            series.append(
                Series(name, times, [rounded(value) for value in values], style, "points" if style == 0 else "line")
            )
        fit = number(float(fitted.validation.fit_percent[i]), 1)
        note = f"All that was held out; simulated from the commands alone. FIT {fit} %."
        axis, title = Axis(f"{channel} [{UNITS[channel]}]"), f"{channel}: measured and simulated, FIT {fit} %"
        made.append(Chart(title, Axis(when), axis, series, note, broad=True))
    return made


def envelope(values: FloatArray, points: int) -> NDArray[np.intp]:
    """Select about `points` rows that preserve the shape of values (n,): extremes of each bin, and every gap."""
    known = np.flatnonzero(np.isfinite(values))
    size = 1 if len(known) <= points else -(-2 * len(known) // points)
    bins = np.split(known, np.arange(size, len(known), size))
    bins = [part for part in bins if len(part)]
    extremes = [part[extreme(values[part])] for part in bins for extreme in (np.argmin, np.argmax)]
    return np.union1d(np.array(extremes, dtype=np.intp), np.flatnonzero(np.isnan(values)))


def draw_simulation(report: IdentificationReport, path: Path) -> None:
    """Draw all held-out data, v next to omega, in as many rows of time as fit on a page."""
    records = report.data.validation
    total = sum(record.dt * len(record.command) for record in records)
    rows = min(_ROWS, max(1, int(np.ceil(total / WINDOW))))
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
    """Chart the response of both outputs to a unit step of each command, dead time included."""
    model = report.fitted.identified.model
    time, responses = step_responses(report)
    x, made = [round(float(value), 4) for value in time], []
    for j, command in enumerate(CHANNELS):
        series = [
            Series(f"{channel} [{UNITS[channel]}]", x, [rounded(value) for value in responses[j][:, i]], i, "line")
            for i, channel in enumerate(CHANNELS)
        ]
        steady = ", ".join(f"{channel} {model.dc_gain[i, j]:.3f}" for i, channel in enumerate(CHANNELS))
        note = f"Dead time {1e3 * model.dead_time[j]:.0f} ms; steady {steady}."
        marks = [Mark(1.0, ""), Mark(float(model.dead_time[j]), "dead time", upright=True)]
        title = f"Step of {command}_ref by 1 {UNITS[command]}"
        made.append(Chart(title, Axis("time [s]"), Axis("response"), series, note, marks))
    return made


def order_charts(report: IdentificationReport) -> list[Chart]:
    """Chart FIT over order, training and validation."""
    choice = report.fitted.orders
    assert choice is not None
    orders, made = list(range(1, len(choice.rows) + 1)), []
    for i, channel in enumerate(CHANNELS):
        kinds = {"training": "train_fit_percent", "validation": "validation_fit_percent"}
        series = [
            Series(kind, orders, [rounded(getattr(row, name)[i]) for row in choice.rows], k)
            for k, (kind, name) in enumerate(kinds.items())
        ]
        marks = [Mark(choice.order, "chosen", upright=True)]
        made.append(Chart(f"Orders compared, {channel}", Axis("order"), Axis("FIT [%]"), series, "", marks))
    return made


def drift_charts(report: IdentificationReport) -> list[Chart]:
    """Chart the position error over the time of a free prediction."""
    drift = report.poses.drift
    x = [row.horizon for row in drift]
    series = [
        Series("RMSE", x, [rounded(row.position_rmse) for row in drift], 0),
        Series("mean", x, [rounded(row.position_mean) for row in drift], 1),
    ]
    axes = Axis("time since the poses agreed [s]"), Axis("position error [m]")
    return [Chart("Drift of the pose", *axes, series)]


def draw_residuals(report: IdentificationReport, path: Path) -> None:
    """Draw autocorrelation and cross-correlations of both residuals, each with its 95 % bound."""
    check = report.fitted.validation.residuals
    lags = check.lag_step * np.arange(check.autocorrelation.shape[1])
    both = check.lag_step * (np.arange(check.cross_correlation.shape[2]) - len(lags) + 1)
    with new_figure(path, 7.4, 6.0) as figure:
        panels = figure.subplots(2, 3, width_ratios=(1.0, 1.3, 1.3))
        for i, channel in enumerate(CHANNELS):
            panel = panels[i, 0]
            panel.axhspan(-check.whiteness_bound, check.whiteness_bound, color=REFERENCE_COLOUR, alpha=0.3, linewidth=0)
            panel.plot(lags, check.autocorrelation[i], color=colour(i))
            panel.set(xlabel="lag [s]", ylabel=f"residual of {channel}", title="with itself")
            for j, command in enumerate(CHANNELS):
                axes = panels[i, 1 + j]
                bound = check.cross_bound[i, j]
                axes.axhspan(-bound, bound, color=REFERENCE_COLOUR, alpha=0.3, linewidth=0, label="95 % bound")
                axes.plot(both, check.cross_correlation[i, j], color=colour(i))
                axes.axvline(0.0, color="black", linewidth=0.6)
                reach = 1.15 * max(2.0 * bound, float(np.abs(check.cross_correlation[i, j]).max()))
                axes.set(xlabel="command before residual by [s]", title=f"with {command}_ref", ylim=(-reach, reach))
        panels[0, 1].legend(loc="upper left")
        figure.suptitle(f"{report.name}: correlation of validation residuals; inside the grey, nothing is left")


def step_responses(report: IdentificationReport) -> tuple[FloatArray, list[FloatArray]]:
    """Compute times (n,) [s], and for a unit step of each command both outputs (n, 2)."""
    model = report.fitted.identified.model
    discrete = model.discretise(_STEP_RESPONSE * float(model.lag.max()) / _SAMPLES)
    time = discrete.dt * np.arange(_SAMPLES + 1)
    return np.asarray(time), [discrete.simulate(np.tile(np.eye(2)[j], (len(time), 1))) for j in range(2)]


_FAR_APART = 8.0
"""Ratio of the fastest pole to the slowest from which a linear axis would press the slow ones together."""


def draw_poles(report: IdentificationReport, path: Path) -> None:
    """Draw the poles with their values, and 95 % intervals where the estimate states them; real ones row by row."""
    identified = report.fitted.identified
    poles = np.sort_complex(identified.model.poles)
    all_real = not poles.imag.any()

    def level(pole: complex) -> float:
        # On one line real poles and their intervals would hide each other.
        return -float(np.argmin(np.abs(poles.real - pole.real))) if all_real else pole.imag

    with new_figure(path, 5.6, 4.2) as figure:
        axes = figure.add_subplot()
        for real, imag, real_deviation, imag_deviation in _uncertain_poles(identified):
            for sign in (1.0, -1.0) if imag else (1.0,):
                axes.errorbar(
                    real,
                    level(complex(real, sign * imag)),
                    xerr=_INTERVAL * real_deviation,
                    yerr=_INTERVAL * imag_deviation if imag else None,
                    color=colour(1),
                    capsize=2.5,
                    linewidth=1.0,
                )
        for pole in poles:
            axes.plot(pole.real, level(pole), "x", color=colour(0), markersize=8, markeredgewidth=1.8)
            value = f"{pole.real:.3g}{pole.imag:+.3g}j" if pole.imag else f"{pole.real:.3g}"
            axes.annotate(value, (pole.real, level(pole)), (0, 7), textcoords="offset points", ha="center")
        # An interval may be infinite; the poles set the scale, which is logarithmic if they are far apart.
        most = float(np.abs(poles).max())
        least = float(np.abs(poles.real[poles.real != 0.0]).min(initial=most))
        if most > _FAR_APART * least:
            axes.set_xscale("symlog", linthresh=0.5 * least)
            axes.set_xlim(-3.0 * most, 0.0)
        else:
            axes.set_xlim(-1.4 * most, 0.05 * most)
        if all_real:
            axes.set_yticks([])
            axes.set(ylim=(-len(poles), 1.0), ylabel="real poles, the fastest above")
        else:
            axes.axhline(0.0, color="black", linewidth=0.6)
            height = max(most / 3, 1.4 * float(np.abs(poles.imag).max()))
            axes.set(ylim=(-height, height), ylabel="imaginary part [rad/s]")
        axes.set(xlabel="real part [rad/s]", title=f"{report.name}: poles, bars are 95 % intervals")


def _uncertain_poles(identified: IdentifiedModel) -> list[tuple[float, float, float, float]]:
    """List real and imaginary part of each pole with known uncertainty, and their standard deviations [rad/s]."""
    rows = []
    for poles in identified.poles:
        for name in poles.names:
            pole, _, part = name.partition(".")
            if part == "real":
                imag = f"{pole}.imag"
                rows.append((poles.value(name), poles.value(imag), poles.deviation(name), poles.deviation(imag)))
            elif not part:
                rows.append((poles.value(name), 0.0, poles.deviation(name), 0.0))
    return rows
