"""The figures of the saving study; numbers of figures in titles are those of Ordonez et al., 2017."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from diffdrive_mpc.bench.figure_style import MARKERS, REFERENCE_COLOUR, colour, line_style, new_figure
from diffdrive_mpc.models.interface import FloatArray
from studies.saving.drives import AIMS, PairOutcome, PlanDrive, Saved
from studies.saving.scenarios import Planned, ScenarioOutcome

_COLUMNS = 6
# Outlines that are drawn along a path.
_OUTLINES = 9
RUNS = 4
"""Runs on each floor in the figure after P4's figure 25."""


def draw_paths(outcomes: Sequence[PairOutcome], surface: str, path: Path) -> None:
    """Draw true paths of each pair, energy-optimal and distance-optimal."""
    rows = -(-len(outcomes) // _COLUMNS)
    with new_figure(path, 7.6, 1.35 * rows + 0.5) as figure:
        panels = figure.subplots(rows, min(_COLUMNS, len(outcomes)), squeeze=False).ravel()
        for axes, outcome in zip(panels, outcomes, strict=False):
            for k, aim in enumerate(AIMS[:2]):
                if aim in outcome.drives:
                    x, y = outcome.drives[aim].path[:, :2].T
                    axes.plot(x, y, line_style(k), color=colour(k), linewidth=1.1, label=f"least {aim}")
            _arrow(axes, outcome.pair.goal)
            axes.plot(*outcome.pair.start[:2], "o", color="black", markersize=2.5)
            saving = outcome.saving()
            axes.set_title(
                f"{outcome.number + 1}: " + (f"{100 * saving:.0f} %" if np.isfinite(saving) else "-"), fontsize=8
            )
            axes.set_aspect("equal", "datalim")
            axes.tick_params(labelsize=6, length=2)
        for axes in panels[len(outcomes) :]:
            axes.set_visible(False)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=2)
        figure.suptitle(f"Driven on '{surface}', with what is saved; x, y [m]", x=0.02, ha="left", fontsize=10)


def draw_saving(floors: Sequence[tuple[str, Sequence[PairOutcome]]], asked: float, path: Path) -> None:
    """Draw the saving of each pair, sorted, and its mean with the interval."""
    with new_figure(path, 7.6, 2.9) as figure:
        panels = figure.subplots(1, len(floors), sharey=True, squeeze=False)[0]
        for axes, (surface, outcomes) in zip(panels, floors, strict=True):
            savings = np.sort([100 * outcome.saving() for outcome in outcomes if np.isfinite(outcome.saving())])
            axes.bar(np.arange(len(savings)), savings, color=colour(0), width=0.8)
            mean = Saved.of(outcomes).mean
            axes.axhspan(100 * mean.low, 100 * mean.high, color=colour(1), alpha=0.35, label="95 % interval")
            axes.axhline(100 * mean.value, color=colour(1), label=f"mean {100 * mean.value:.1f} %")
            axes.axhline(asked, color=REFERENCE_COLOUR, linestyle="--", label=f"asked {asked:g} %")
            axes.axhline(0.0, color="black", linewidth=0.8)
            axes.set(title=f"'{surface}'", xlabel="pair, sorted", xticks=[])
            axes.legend(loc="upper left")
        panels[0].set_ylabel("energy saved [%]")


def draw_prediction(floors: Sequence[tuple[str, Sequence[PairOutcome]]], path: Path) -> None:
    """Draw predicted against measured energy of every drive, and its error in the first runs (as figure 25)."""
    with new_figure(path, 7.6, 3.5) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
        ticks: list[int] = []
        most, offset = 1.0, 0
        for k, (surface, outcomes) in enumerate(floors):
            for aim, filled in zip(AIMS[:2], (True, False), strict=True):
                drives = [
                    outcome.drives[aim] for outcome in outcomes if aim in outcome.drives and outcome.drives[aim].arrived
                ]
                measured, predicted = [drive.measured for drive in drives], [drive.predicted for drive in drives]
                most = max(most, *measured, *predicted) if drives else most
                left.plot(
                    measured,
                    predicted,
                    MARKERS[k],
                    color=colour(k),
                    markersize=4,
                    markerfacecolor=colour(k) if filled else "none",
                    label=f"'{surface}'" if filled else None,
                )
            runs = [outcome.drives["energy"] for outcome in outcomes[:RUNS] if "energy" in outcome.drives]
            errors = [100 * run.error if run.arrived else np.nan for run in runs]
            places = offset + 1 + np.arange(len(errors))
            right.bar(places, errors, color=colour(k), label=f"'{surface}'")
            ticks, offset = [*ticks, *places.tolist()], offset + len(errors)
        line = np.array([0.0, 1.08 * most])
        left.plot(line, line, color=REFERENCE_COLOUR)
        left.fill_between(line, 0.9 * line, 1.1 * line, color=REFERENCE_COLOUR, alpha=0.2, label="within 10 %")
        left.set(xlabel="measured [J]", ylabel="predicted [J]", title="All drives; open: least distance")
        left.legend()
        right.axhline(0.0, color="black", linewidth=0.8)
        right.set(xlabel="run", ylabel="predicted less measured [%]", xticks=ticks)
        right.set_title(f"First {RUNS} of each floor, least energy (as figure 25)")
        right.legend()


def draw_scenario(scenario: ScenarioOutcome, outline: tuple[float, float], path: Path) -> None:
    """Draw what was planned, executed open loop, and by the controller."""
    with new_figure(path, 7.6, 3.7) as figure:
        panels = figure.subplots(1, len(scenario.plans), sharex=True, sharey=True)
        for axes, plan in zip(panels, scenario.plans, strict=True):
            for k, (name, points) in enumerate(_paths_of(plan)):
                axes.plot(points[:, 0], points[:, 1], line_style(k), color=colour(k), label=name)
            for corners in _outlines(plan.open.path, outline):
                axes.add_patch(Polygon(corners, fill=False, edgecolor=colour(1), linewidth=0.5, alpha=0.6))
            for x, y, radius in scenario.asked.posts:
                axes.add_patch(Circle((x, y), radius, color=colour(4)))
            _arrow(axes, (*scenario.asked.goal[:2], np.deg2rad(scenario.asked.goal[2])))
            axes.set_aspect("equal")
            axes.set(xlabel="x [m]", title=f"Plan: {plan.by}")
            axes.text(0.03, 0.97, _words(plan), transform=axes.transAxes, va="top", fontsize=8)
        panels[0].set_ylabel("y [m]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        figure.suptitle(
            f"{scenario.title} (as figure{'s' if ' ' in scenario.figures else ''} {scenario.figures})", fontsize=10
        )


def _paths_of(plan: Planned) -> list[tuple[str, FloatArray]]:
    return [
        ("planned", plan.open.planned),
        ("executed, open loop", plan.open.path),
        ("by the controller", plan.closed.path),
    ]


def _words(plan: Planned) -> str:
    def energy(name: str, drive: PlanDrive) -> str:
        return f"{name} {drive.measured:.0f} J ({100 * drive.error:+.1f} %)"

    touched = [name for name, gap in zip(("open loop", "controller"), plan.gaps, strict=True) if gap < 0]
    lines = [
        f"predicted {plan.open.predicted:.0f} J",
        energy("open loop", plan.open),
        energy("controller", plan.closed),
    ]
    lines.append(f"open loop ends {plan.open.position:.2f} m off")
    return "\n".join([*lines, *(f"{name}: touches a cone" for name in touched)])


def _outlines(path: FloatArray, outline: tuple[float, float]) -> list[FloatArray]:
    corners = 0.5 * np.array(outline) * [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    outlines = []
    for x, y, theta in path[np.linspace(0, len(path) - 1, _OUTLINES).astype(int)]:
        c, s = np.cos(theta), np.sin(theta)
        outlines.append(np.array([x, y]) + corners @ np.array([[c, s], [-s, c]]))
    return outlines


def _arrow(axes: Axes, pose: Sequence[float]) -> None:
    x, y, theta = pose
    axes.plot(x + 0.9 * np.cos(theta), y + 0.9 * np.sin(theta), alpha=0.0)
    axes.annotate(
        "",
        (x + 0.8 * np.cos(theta), y + 0.8 * np.sin(theta)),
        (x, y),
        arrowprops={"arrowstyle": "->", "linewidth": 1.0},
    )
