"""Residuals on data held out: their own correlation, and that with the commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure
from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.models.velocity_model import CHANNELS


def draw_residuals(outcome: Outcome, path: Path) -> None:
    """Draw autocorrelation and cross-correlations of both residuals, each with its 95 % bound."""
    check = outcome.fitted.validation.residuals
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
        figure.suptitle(f"{outcome.name}: correlation of validation residuals; inside the grey, nothing is left")
