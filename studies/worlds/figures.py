"""The figures of the study: rates, and ways through worlds from above."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.bench.outcomes import group
from diffdrive_mpc.bench.study import Draw
from diffdrive_mpc.bench.world_drawing import draw_world
from diffdrive_mpc.sim.worlds.world_file import load_world
from studies.worlds.results import Rows, WorldOutcome, arrived, collided, rate

_SHOWN = 6


def drawings(rows: Rows) -> dict[str, Draw]:
    """What draws each figure, by file name."""
    parts = group(rows, lambda one: one.part)
    found: dict[str, Draw] = {}
    if "drawn" in parts:
        found["rates.png"] = partial(draw_rates, parts["drawn"])
        found["drawn.png"] = partial(draw_worlds, _densest(parts["drawn"]))
    named = [one for part in ("doorway", "named", "crossing") for one in parts.get(part, [])]
    if named:
        first = {name: runs[0].case.seed for name, runs in group(named, lambda one: one.case.world).items()}
        found["named.png"] = partial(draw_worlds, [one for one in named if one.case.seed == first[one.case.world]])
    return found


def _densest(rows: Rows) -> list[WorldOutcome]:
    """Runs of the worlds with posts on the way among the first seeds, then of others."""
    worlds = list(group(rows, lambda one: one.case.world))
    chosen = sorted(worlds, key=lambda name: not name.endswith(":through"))[:_SHOWN]
    return [one for one in rows if one.case.world in chosen]


def draw_rates(rows: Rows, path: Path) -> None:
    """Draw how often each controller arrived and collided, with intervals."""
    kinds = group(rows, lambda one: one.through)
    with new_figure(path, 8.0, 3.2) as figure:
        panels = figure.subplots(1, len(kinds), squeeze=False, sharey=True)[0]
        for axes, (through, runs) in zip(panels, sorted(kinds.items()), strict=True):
            drivers = group(runs, lambda one: one.driver)
            for i, (_, own) in enumerate(drivers.items()):
                for j, (counted, said) in enumerate(((arrived, "arrived"), (collided, "collided"))):
                    of = rate(own, counted)
                    error = [[100 * (of.share - of.low)], [100 * (of.high - of.share)]]
                    axes.bar(
                        i + 0.4 * j - 0.2,
                        100 * of.share,
                        0.36,
                        yerr=error,
                        capsize=3,
                        color=colour(2 if j == 0 else 1),
                        alpha=0.85,
                        label=said if i == 0 else None,
                    )
            axes.set_xticks(range(len(drivers)), list(drivers))
            axes.set(title="posts on the planned way" if through else "the planned way is free", ylim=(0, 105))
            axes.grid(axis="x", visible=False)
        panels[0].set_ylabel("share of runs [%], 95 % interval")
        panels[0].legend(loc="center left")


def draw_worlds(rows: Sequence[WorldOutcome], path: Path) -> None:
    """Draw worlds from above with the ways that controllers took in them."""
    worlds = group(rows, lambda one: (one.case.world, one.case.seed))
    columns = min(2, len(worlds))
    lines = -(-len(worlds) // columns)
    drivers = list(group(rows, lambda one: one.driver))
    with new_figure(path, 9.0, 0.4 + 2.7 * lines) as figure:
        panels = figure.subplots(lines, columns, squeeze=False).ravel()
        for axes, ((name, seed), runs) in zip(panels, worlds.items(), strict=False):
            world = load_world(name, seed)
            draw_world(axes, world)
            if world.way is not None:
                axes.plot(*np.array(world.way.waypoints).T, color=REFERENCE_COLOUR, linewidth=3.0, alpha=0.5)
            for one in runs:
                i = drivers.index(one.driver)
                axes.plot(*one.path.T, color=colour(i), linestyle=line_style(i), linewidth=1.3)
                if not arrived(one):
                    axes.plot(*one.path[-1], marker="x" if collided(one) else "s", color=colour(i), markersize=7)
            axes.set(title=name, aspect="equal")
        for axes in panels[len(worlds) :]:
            axes.set_axis_off()
        for i, driver in enumerate(drivers):
            panels[0].plot([], [], color=colour(i), linestyle=line_style(i), label=driver)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(drivers))
