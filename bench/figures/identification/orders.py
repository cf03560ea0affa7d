"""How much each order of SSM explains."""

from __future__ import annotations

from pathlib import Path

from matplotlib.ticker import MaxNLocator

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.identification.outcome import Outcome
from diffdrive_mpc.models.velocity_model import CHANNELS


def draw_orders(outcome: Outcome, path: Path) -> None:
    """Draw FIT over order, training and validation."""
    choice = outcome.fitted.orders
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
        figure.suptitle(f"{outcome.name}: orders compared")
