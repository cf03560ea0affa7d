"""The figures of the study: rates, and ways through worlds from above."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from pandas import DataFrame

from diffdrive_mpc.bench.experiment import by
from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.html_report.page import Axis, Chart, Series
from diffdrive_mpc.bench.study import Charts, Draw
from diffdrive_mpc.extras.planner.world_drawing import draw_world
from diffdrive_mpc.sim.worlds.world_file import load_world
from studies.worlds.results import rate

_SHOWN = 6


def drawings(rows: DataFrame) -> dict[str, Draw | Charts]:
    """Each figure by file name."""
    pages: dict[str, Draw | Charts] = {}
    drawn = rows[rows["part"] == "drawn"]
    if len(drawn):
        pages["rates.png"] = rate_charts(drawn)
        pages["drawn.png"] = partial(draw_worlds, _densest(drawn))
    named = rows[rows["part"] != "drawn"]
    if len(named):
        first = named.groupby("world")["seed"].transform("first")
        pages["named.png"] = partial(draw_worlds, named[named["seed"] == first])
    return pages


def _densest(rows: DataFrame) -> DataFrame:
    """Runs of the worlds with posts on the way among the first seeds, then of others."""
    chosen = sorted(by(rows, "world"), key=lambda name: not name.endswith("through"))[:_SHOWN]
    return rows[rows["world"].isin(chosen)]


def rate_charts(rows: DataFrame) -> list[Chart]:
    """How often each controller arrived and collided, with intervals."""
    made = []
    for planned, part in sorted(by(rows, "planned_way").items()):
        drivers, series = by(part, "driver"), []
        for style, (column, name) in enumerate((("passage_arrived", "arrived"), ("collided", "collided"))):
            charts = [rate(own, column) for own in drivers.values()]
            low, high = ([100 * getattr(chart, end) for chart in charts] for end in ("low", "high"))
            series.append(
                Series(name, list(drivers), [100 * chart.share for chart in charts], 2 - style, "bars", low, high)
            )
        axes = Axis("", "category"), Axis("share of runs [%], 95 % interval", range=(0, 105))
        made.append(Chart(f"Planned way: {planned}", *axes, series))
    return made


def draw_worlds(rows: DataFrame, path: Path) -> None:
    """Draw worlds from above with the ways that controllers took in them."""
    worlds = dict(iter(rows.groupby([[case.world for case in rows["case"]], "seed"], sort=False)))
    columns = min(2, len(worlds))
    lines = -(-len(worlds) // columns)
    drivers = list(by(rows, "driver"))
    with new_figure(path, 9.0, 0.4 + 2.7 * lines) as figure:
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, ((name, seed), own) in zip(panels, worlds.items(), strict=False):
            world = load_world(name, seed)
            draw_world(axes, world)
            if world.way is not None:
                axes.plot(*np.array(world.way.waypoints).T, color=REFERENCE_COLOUR, linewidth=3.0, alpha=0.5)
            for row in own.itertuples():
                i = drivers.index(row.driver)
                axes.plot(*row.path.T, color=colour(i), linestyle=line_style(i), linewidth=1.3)
                if not row.passage_arrived:
                    axes.plot(*row.path[-1], marker="x" if row.collided else "s", color=colour(i), markersize=7)
            axes.set(title=name, aspect="equal")
        for axes in panels[len(worlds) :]:
            axes.set_axis_off()
        for i, driver in enumerate(drivers):
            panels[0].plot([], [], color=colour(i), linestyle=line_style(i), label=driver)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(drivers))
