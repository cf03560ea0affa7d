"""Measured against simulated, on data that the model was not identified from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.bench.identification.settings import report_settings
from diffdrive_mpc.models.identification.signals import twist_stretches
from diffdrive_mpc.models.interface import FloatArray

_LABELS = ("v [m/s]", "omega [rad/s]")


def draw_simulation(outcome: Outcome, path: Path) -> None:
    """Draw the busiest window of the longest validation stretch: both channels, with their residuals below."""
    data, fitted = outcome.data, outcome.fitted
    longest = int(np.argmax([len(record.command) for record in data.validation]))
    record, simulated = data.validation[longest], fitted.simulated[longest]
    (stretch,) = twist_stretches([record], data.yaw)
    first = _busiest(record.command, round(report_settings().window / record.dt))
    rows = slice(first, first + round(report_settings().window / record.dt))
    time = record.time[rows]
    with new_figure(path, 7.4, 6.6) as figure:
        panels = figure.subplots(4, 1, sharex=True, height_ratios=(2.2, 1.0, 2.2, 1.0))
        for i in (0, 1):
            upper, lower = panels[2 * i], panels[2 * i + 1]
            measured = np.where(stretch.counts[:, i], stretch.outputs[:, i], np.nan)[rows]
            seen = np.isfinite(measured)
            upper.step(
                time, record.command[rows, i], where="post", color=REFERENCE_COLOUR, linewidth=0.9, label="command"
            )
            upper.plot(time[seen], measured[seen], ".", markersize=2.5, color=colour(0), label="measured")
            upper.plot(time, simulated[rows, i], color=colour(1), label="simulated")
            upper.set_ylabel(_LABELS[i])
            lower.plot(time[seen], (measured - simulated[rows, i])[seen], color=colour(0), linewidth=0.8)
            lower.axhline(0.0, color="black", linewidth=0.6)
            lower.set_ylabel("residual")
        panels[0].legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels[-1].set_xlabel("time on the log's clock [s]")
        fit = fitted.validation.fit_percent
        figure.suptitle(f"{outcome.name}: validation FIT v {fit[0]:.1f} %, omega {fit[1]:.1f} % (of all stretches)")
        figure.align_ylabels(panels)


def _busiest(commands: FloatArray, window: int) -> int:
    """First row of the window in which the commands, each over its own spread, change most."""
    if len(commands) <= window:
        return 0
    change = np.abs(np.diff(commands, axis=0, prepend=commands[:1]))
    activity = np.cumsum((change / np.maximum(np.ptp(commands, axis=0), np.finfo(float).tiny)).sum(axis=1))
    return int(np.argmax(activity[window - 1 :] - np.concatenate([[0.0], activity[:-window]])))
