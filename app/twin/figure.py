"""The picture of a twin: measured, twin and identified model on rows that neither was made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.app.identification.figures import busiest, figure_settings
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.numbers import from_zero
from diffdrive_mpc.sim.twin.from_log import FittedTwin

_UNITS = {"v": "m/s", "omega": "rad/s"}


def draw_held_out(twin: FittedTwin, path: Path) -> None:
    """Draw the busiest window of the longest stretch held out, v above and omega below."""
    longest = int(np.argmax([run.samples for run in twin.experiments]))
    run, record = twin.experiments[longest], twin.data.validation[longest]
    window = round(figure_settings().window / run.dt)
    first = busiest(run.inputs, window)
    rows = slice(first, first + window)
    time, when = from_zero(record.time[rows])
    with new_figure(path, 7.4, 5.2) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for panel, (i, (channel, unit)) in zip(panels, enumerate(_UNITS.items()), strict=True):
            seen = run.counts[rows, -i]
            panel.step(time, run.inputs[rows, i], where="post", color=REFERENCE_COLOUR, linewidth=0.9, label="command")
            panel.plot(time[seen], run.outputs[rows, -i][seen], ".", markersize=2.5, color=colour(0), label="measured")
            for k, (name, held) in enumerate((("twin", twin.twin_held), ("identified model", twin.model_held))):
                fit = held.fit_percent[channel]
                values = held.predictions[longest].readings[rows, -i]
                panel.plot(time, values, line_style(k), color=colour(k + 1), label=f"{name}: FIT {fit:.1f} %")
            panel.set_ylabel(f"{channel} [{unit}]")
            panel.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels[-1].set_xlabel(when)
        figure.align_ylabels(panels)
