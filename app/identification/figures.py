"""The figures of an identification."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.numbers import from_zero
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.identification.report import IdentificationReport
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.output_error.experiment import twist_experiments
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.robot import Positive
from diffdrive_mpc.models.structures.identified import IdentifiedModel
from diffdrive_mpc.models.velocity_model import CHANNELS

FOLDER = "figures"
"""Of the figures, inside that of the results."""
UNITS = {"v": "m/s", "omega": "rad/s"}
_SAMPLES = 400
_INTERVAL = 1.959964

Draw = Callable[[IdentificationReport, Path], None]


class FigureSettings(StrictModel):
    """Sizes, as in `figures.yaml`."""

    window: Positive
    step_response: Positive


@cache
def figure_settings() -> FigureSettings:
    """Read `figures.yaml`; raises ConfigError on a mistake in it."""
    return load_checked(FigureSettings, Path(__file__).with_name("figures.yaml"))


def draw_identification(report: IdentificationReport, folder: Path, on_done: Callable[[], None]) -> dict[str, str]:
    """Draw the figures into `FOLDER` inside `folder`; `on_done` is called after each.

    Returns
    -------
    dict
        Title and path of each file, relative to `folder`, in the order to be shown.
    """
    (folder / FOLDER).mkdir()
    paths = {}
    for title, (name, draw) in figures_of(report).items():
        paths[title] = f"{FOLDER}/{name}"
        draw(report, folder / paths[title])
        on_done()
    return paths


def figures_of(report: IdentificationReport) -> dict[str, tuple[str, Draw]]:
    """Title, file name and drawing function of each figure that the report has something for."""
    jobs: dict[str, tuple[str, Draw]] = {
        "Measured against simulated": ("simulation.png", draw_simulation),
        "What residuals still hold": ("residuals.png", draw_residuals),
    }
    if report.fitted.predictor is None:
        jobs |= {"Step responses": ("steps.png", draw_steps), "Poles": ("poles.png", draw_poles)}
    if report.fitted.orders:
        jobs["Orders of SSM"] = ("orders.png", draw_orders)
    if report.poses.drift:
        jobs["Drift of the pose"] = ("drift.png", draw_drift)
    return jobs


def draw_simulation(report: IdentificationReport, path: Path) -> None:
    """Draw the busiest window of the longest validation stretch: both channels, with their residuals below."""
    data, fitted = report.data, report.fitted
    longest = int(np.argmax([len(record.command) for record in data.validation]))
    record, simulated = data.validation[longest], fitted.simulated[longest]
    (experiment,) = twist_experiments([record], data.yaw)
    first = busiest(record.command, round(figure_settings().window / record.dt))
    rows = slice(first, first + round(figure_settings().window / record.dt))
    time, when = from_zero(record.time[rows])
    with new_figure(path, 7.4, 6.6) as figure:
        panels = figure.subplots(4, 1, sharex=True, height_ratios=(2.2, 1.0, 2.2, 1.0))
        for i, channel in enumerate(CHANNELS):
            upper, lower = panels[2 * i], panels[2 * i + 1]
            measured = np.where(experiment.counts[:, i], experiment.outputs[:, i], np.nan)[rows]
            seen = np.isfinite(measured)
            upper.step(
                time, record.command[rows, i], where="post", color=REFERENCE_COLOUR, linewidth=0.9, label="command"
            )
            upper.plot(time[seen], measured[seen], ".", markersize=2.5, color=colour(0), label="measured")
            upper.plot(time, simulated[rows, i], color=colour(1), label="simulated")
            upper.set_ylabel(f"{channel} [{UNITS[channel]}]")
            lower.plot(time[seen], (measured - simulated[rows, i])[seen], color=colour(0), linewidth=0.8)
            lower.axhline(0.0, color="black", linewidth=0.6)
            lower.set_ylabel("residual")
        panels[0].legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels[-1].set_xlabel(when)
        fit = fitted.validation.fit_percent
        figure.suptitle(f"{report.name}: validation FIT v {fit[0]:.1f} %, omega {fit[1]:.1f} % (of all stretches)")
        figure.align_ylabels(panels)


def busiest(commands: FloatArray, window: int) -> int:
    """First row of the window in which the commands, each over its own spread, change most."""
    if len(commands) <= window:
        return 0
    change = np.abs(np.diff(commands, axis=0, prepend=commands[:1]))
    activity = np.cumsum((change / np.maximum(np.ptp(commands, axis=0), np.finfo(float).tiny)).sum(axis=1))
    return int(np.argmax(activity[window - 1 :] - np.concatenate([[0.0], activity[:-window]])))


def draw_residuals(report: IdentificationReport, path: Path) -> None:
    """Draw autocorrelation and cross-correlations of both residuals, each with its 95 % bound."""
    check = report.fitted.validation.residuals
    lags = check.lag_step * np.arange(check.autocorrelation.shape[1])
    both = check.lag_step * (np.arange(check.cross_correlation.shape[2]) - len(lags) + 1)
    with new_figure(path, 7.4, 6.0) as figure:
        panels = figure.subplots(2, 3, width_ratios=(1.0, 1.3, 1.3))
        for i, channel in enumerate(CHANNELS):
            own = panels[i, 0]
            own.axhspan(-check.whiteness_bound, check.whiteness_bound, color=REFERENCE_COLOUR, alpha=0.3, linewidth=0)
            own.plot(lags, check.autocorrelation[i], color=colour(i))
            own.set(xlabel="lag [s]", ylabel=f"residual of {channel}", title="with itself")
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


def draw_steps(report: IdentificationReport, path: Path) -> None:
    """Draw the response of both outputs to a unit step of either command, dead time included."""
    model = report.fitted.identified.model
    time, responses = step_responses(report)
    with new_figure(path, 7.4, 3.4) as figure:
        panels = figure.subplots(1, 2)
        for j, (axes, command) in enumerate(zip(panels, CHANNELS, strict=True)):
            axes.axhline(1.0, color=REFERENCE_COLOUR, linewidth=0.9, linestyle=":")
            for i, channel in enumerate(CHANNELS):
                label = f"{channel} [{UNITS[channel]}], steady {model.dc_gain[i, j]:.3f}"
                axes.plot(time, responses[j][:, i], color=colour(i), linestyle=line_style(i), label=label)
            axes.axvline(model.dead_time[j], color="black", linewidth=0.6)
            axes.set(xlabel="time [s]", title=f"step of {command}_ref by 1 {UNITS[command]}")
            axes.legend(loc="center right")
        figure.suptitle(f"{report.name}: step responses; the upright line is the dead time")


def step_responses(report: IdentificationReport) -> tuple[FloatArray, list[FloatArray]]:
    """Times (n,) [s], and for a unit step of each command both outputs (n, 2)."""
    model = report.fitted.identified.model
    discrete = model.discretise(figure_settings().step_response * float(model.lag.max()) / _SAMPLES)
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
        # An interval may reach to infinity; the poles set the scale, which is logarithmic where they lie far apart.
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
    """Real and imaginary part of each pole whose uncertainty is known, and their standard deviations [rad/s]."""
    found = identified.parameters
    rows = []
    for name in found.names:
        pole, _, part = name.partition(".")
        damping = name.replace("natural_frequency", "damping")
        if damping != name and damping in found.names:
            pair = found.part([name, damping])
            rows += [_row(pair.derived(("real", "imag"), parts)) for parts in _POLES[bool(pair.values[1] < 1.0)]]
        elif pole.startswith("pole_") and part == "real":
            rows.append(_row(found.part([name, f"{pole}.imag"])))
        elif pole.startswith("pole_") and not part:
            rows.append((found.value(name), 0.0, found.deviation(name), 0.0))
    return rows


def _row(pole: ParameterEstimate) -> tuple[float, float, float, float]:
    (real, imag), (real_deviation, imag_deviation) = pole.values, pole.standard_deviation
    return float(real), float(imag), float(real_deviation), float(imag_deviation)


def _root(damping: float) -> float:
    return float(np.sqrt(abs(damping**2 - 1.0)))


# From natural frequency and damping: both poles where they are real, the upper one of a pair that is complex.
_POLES: dict[bool, list[Callable[[FloatArray], FloatArray]]] = {
    False: [
        lambda row: np.array([-row[0] * (row[1] - _root(row[1])), 0.0]),
        lambda row: np.array([-row[0] * (row[1] + _root(row[1])), 0.0]),
    ],
    True: [lambda row: np.array([-row[0] * row[1], row[0] * _root(row[1])])],
}


def draw_orders(report: IdentificationReport, path: Path) -> None:
    """Draw FIT over order, training and validation."""
    choice = report.fitted.orders
    assert choice is not None
    orders = list(range(1, len(choice.rows) + 1))
    with new_figure(path, 7.4, 3.4) as figure:
        for i, (axes, channel) in enumerate(zip(figure.subplots(1, 2, sharex=True), CHANNELS, strict=True)):
            axes.axvline(choice.order, color=REFERENCE_COLOUR, linewidth=6.0, alpha=0.3, label="chosen")
            kinds = {"training": "train_fit_percent", "validation": "validation_fit_percent"}
            for k, (kind, name) in enumerate(kinds.items()):
                fits = [getattr(row, name)[i] for row in choice.rows]
                axes.plot(orders, fits, marker="os"[k], color=colour(k), linestyle=line_style(k), label=kind)
            axes.set(xlabel="order", ylabel="FIT [%]", title=channel)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(loc="lower right")
        figure.suptitle(f"{report.name}: orders compared")


def draw_drift(report: IdentificationReport, path: Path) -> None:
    """Draw position and heading error over the horizon."""
    drift = report.poses.drift
    horizon = [entry.horizon for entry in drift]
    with new_figure(path, 7.4, 3.2) as figure:
        panels = figure.subplots(1, 2)
        quantities = {"position": "position error [m]", "heading": "heading error [rad]"}
        for axes, (name, label) in zip(panels, quantities.items(), strict=True):
            for k, (kind, words) in enumerate({"rmse": "RMSE", "mean": "mean"}.items()):
                errors = [getattr(entry, f"{name}_{kind}") for entry in drift]
                axes.plot(horizon, errors, marker="os"[k], color=colour(k), linestyle=line_style(k), label=words)
            axes.set(xlabel="time since the poses agreed [s]", ylabel=label, xlim=(0, None), ylim=(0, None))
        panels[0].legend()
        figure.suptitle(f"{report.name}: open-loop pose error on data held out")
