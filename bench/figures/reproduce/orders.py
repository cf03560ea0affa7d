"""Test FIT of SSM by order, published and on the simulated robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figures.style import colour, new_figure
from diffdrive_mpc.bench.reproduce.experiments.state_space import PAPERS_ORDER, SsmResult
from diffdrive_mpc.bench.reproduce.published import load_published
from diffdrive_mpc.models.velocity_model import CHANNELS


def draw_orders(results: Sequence[SsmResult], path: Path) -> None:
    """Draw what each order brings over order 2, in v and in omega; bars reach over the repetitions."""
    printed = load_published().orders
    tested = [row.order for row in results[0].orders if row.order >= PAPERS_ORDER]
    with new_figure(path, 9.0, 3.4) as figure:
        for row, (channel, axes) in enumerate(zip(CHANNELS, figure.subplots(1, 2), strict=True)):
            paper = {order: getattr(fit.fit_percent, channel) for order, fit in printed.items()}
            axes.plot(
                list(paper),
                [value - paper[PAPERS_ORDER] for value in paper.values()],
                "s--",
                color=colour(1),
                label=f"published; order 2: {paper[PAPERS_ORDER]:.2f} %",
            )
            fits = np.array(
                [[result.orders[order - 1].test.fit_percent[row] for order in tested] for result in results]
            )
            gains = fits - fits[:, :1]
            mean = gains.mean(axis=0)
            reach = np.abs(np.array([gains.min(axis=0), gains.max(axis=0)]) - mean)
            label = f"our plant; order 2: {fits[:, 0].mean():.2f} %"
            axes.errorbar(tested, mean, yerr=reach, fmt="o-", color=colour(0), capsize=3.0, label=label)
            axes.axhline(0.0, color="black", linewidth=0.6)
            axes.set(title=channel, xlabel="order", xticks=tested, ylabel="test FIT over order 2 [points]")
            axes.legend(loc="best")
