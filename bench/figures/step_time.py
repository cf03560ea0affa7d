"""How long a step takes, as a distribution per controller."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from diffdrive_mpc.bench.figures.style import colour, line_style, new_figure
from diffdrive_mpc.bench.groups import groups, step_times
from diffdrive_mpc.bench.runner import Outcome


def draw_step_times(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the share of steps that took longer than a given time, both axes logarithmic so that the tail shows."""
    with new_figure(path, 6.4, 4.0) as figure:
        axes = figure.add_subplot()
        tail_of_step_times(axes, outcomes)
        axes.set_title("Whole step")


def tail_of_step_times(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    """Complementary distribution of the step time on `axes`, with the sample time as a limit."""
    for i, (name, group) in enumerate(groups(outcomes).items()):
        times = 1e3 * np.sort(step_times(group))
        longer = 1.0 - np.arange(times.size) / times.size
        p99 = float(np.percentile(times, 99))
        axes.step(
            times, longer, where="pre", color=colour(i), linestyle=line_style(i), label=f"{name}, p99 {p99:.2f} ms"
        )
    sample = 1e3 * outcomes[0].run.sample_time
    axes.axvline(sample, color="black", linewidth=0.8, linestyle=":")
    axes.annotate("sample time", (sample, 1.0), (-3, -2), textcoords="offset points", rotation=90, ha="right", va="top")
    axes.axhline(0.01, color="black", linewidth=0.5, alpha=0.5)
    axes.set(xscale="log", yscale="log", xlabel="step time [ms]", ylabel="share of longer steps")
    axes.legend(loc="lower left")
