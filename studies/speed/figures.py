"""Figures of step times: medians against the horizon, and distributions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from numpy.typing import ArrayLike

from diffdrive_mpc.bench.figure_style import MARKERS, colour, line_style, new_figure
from studies.speed.results import ACADOS, SpeedResults


def draw_horizons(results: SpeedResults, path: Path) -> None:
    """Draw the median step time of all solvers against the horizon, with logarithmic axes and one panel per model."""
    models, horizons = results.models, results.horizons
    with new_figure(path, 3.2 * len(models) + 1.6, 3.8) as figure:
        panels = figure.subplots(1, len(models), sharey=True, squeeze=False)[0]
        for axes, model in zip(panels, models, strict=True):
            for i, solver in enumerate(results.solvers):
                times = [1e3 * results.value(solver, model, n, lambda r: r.step_p50_s) for n in horizons]
                axes.plot(
                    horizons,
                    times,
                    color=colour(i),
                    linestyle=line_style(i // 7),
                    marker=MARKERS[i % len(MARKERS)],
                    markersize=4,
                    label=solver,
                )
            if ACADOS in results.solvers:
                solver_times = [1e3 * results.value(ACADOS, model, n, lambda r: r.solver_p50_s) for n in horizons]
                axes.plot(horizons, solver_times, color="black", linestyle=":", label="acados, time inside the solver")
            axes.set(xscale="log", yscale="log", xlabel="horizon [steps]", title=model.upper())
            axes.set_xticks(horizons, [str(n) for n in horizons])
            axes.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_ylabel("whole step, median [ms]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right center")


def draw_tails(results: SpeedResults, horizon: int, path: Path) -> None:
    """Draw the share of steps that exceed a time against this time, for the last model at one horizon."""
    model = results.models[-1]
    with new_figure(path, 6.4, 4.0) as figure:
        axes = figure.add_subplot()
        records = [record for record in results.records if (record.model, record.horizon) == (model, horizon)]
        for entry in records:
            i = results.solvers.index(entry.solver)
            _draw_tail(axes, entry.whole[np.isfinite(entry.whole)], entry.solver, colour(i), line_style(i // 7))
        axes.axhline(0.01, color="black", linewidth=0.5, alpha=0.5)
        axes.set_xlabel("whole step [ms]")
        axes.set_title(f"{model.upper()}, N = {horizon}")
        figure.legend(loc="outside right center")


def _draw_tail(axes: Axes, times: ArrayLike, name: str, line_colour: str, style: str) -> None:
    """Draw the share of `times` [s] that exceed a time, with logarithmic axes, which show the tail."""
    times = 1e3 * np.sort(np.asarray(times, dtype=float))
    share = 1.0 - np.arange(times.size) / times.size
    label = f"{name}, p99 {np.percentile(times, 99):.2f} ms"
    axes.step(times, share, where="pre", color=line_colour, linestyle=style, label=label)
    axes.set(xscale="log", yscale="log", ylabel="share of longer steps")
