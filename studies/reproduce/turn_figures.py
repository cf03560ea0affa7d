"""The figures of P4's turns: torques and powers, learned curves, and energies foreseen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import MARKERS, REFERENCE_COLOUR, colour, line_style, new_figure
from studies.reproduce.published import load_published
from studies.reproduce.turn_learning import LearnedTurns
from studies.reproduce.turning import SteadyTurns, TurningResult

_SIDES = ("outer", "inner")
_BAR = 0.4


def draw_turn_torques(result: TurningResult, path: Path) -> None:
    """Draw torques against radius: the law on vinyl, and the robot (figure 6)."""
    printed = load_published().turning.inner_drives_beyond
    with new_figure(path, 9.0, 3.6) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, turns, driven in ((left, result.law, False), (right, result.driven, True)):
            for k, turn in enumerate(turns):
                for side, name in enumerate(_SIDES):
                    style = f"{MARKERS[k]}-" if driven else line_style(k)
                    label = f"{name}, {turn.speed:g} m/s"
                    axes.plot(
                        turn.radius,
                        turn.torque[:, side],
                        style,
                        color=colour(side),
                        alpha=1 - 0.25 * k,
                        markersize=3.5,
                        label=label,
                    )
            axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
            axes.axvline(printed, color=REFERENCE_COLOUR, linewidth=0.8, linestyle="--")
            axes.set(xscale="log", xlabel="commanded turn radius [m]", title=_title(turns))
        left.annotate(
            "P4: inner drives beyond", (printed, left.get_ylim()[0]), (4, 6), textcoords="offset points", fontsize=7.0
        )
        left.set_ylabel("torque of a side [N m]")
        right.legend()


def draw_turn_power(result: TurningResult, path: Path) -> None:
    """Draw electrical powers against radius at the least and the greatest speed (figure 7)."""
    with new_figure(path, 9.0, 3.6) as figure:
        for axes, turns in zip(figure.subplots(1, 2, sharey=True), (result.law, result.driven), strict=True):
            for k, one in enumerate((turns[0], turns[-1])):
                for side, name in enumerate(_SIDES):
                    label = f"{name}, {one.speed:g} m/s"
                    axes.plot(one.radius, one.power[:, side], line_style(k), color=colour(side), label=label)
                below = np.minimum(one.power[:, 1], 0.0)
                axes.fill_between(one.radius, below, 0.0, color=colour(1), alpha=0.15)
            axes.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
            axes.set(
                xscale="log", xlabel="commanded turn radius [m]", ylabel="power of a side [W]", title=_title(turns)
            )
            axes.legend()


def _title(turns: Sequence[SteadyTurns]) -> str:
    source = turns[0].source
    return "shear law, vinyl" if source == "shear law" else f"simulated robot on '{source}'"


def draw_turn_learning(floors: Sequence[LearnedTurns], path: Path) -> None:
    """Draw curves before and after the drive, with its raw torques as bars (figures 16 to 18)."""
    with new_figure(path, 3.6 * len(floors) + 0.6, 3.8) as figure:
        shown = figure.subplots(1, len(floors), sharey=True, squeeze=False)[0]
        for axes, floor in zip(shown, floors, strict=True):
            for side, name in enumerate(_SIDES):
                least, mean, most = floor.raw[:, 1 + 3 * side : 4 + 3 * side].T
                axes.vlines(floor.raw[:, 0], least, most, color=colour(side), alpha=0.5, linewidth=2.0)
                axes.plot(floor.raw[:, 0], mean, "_", color=colour(side), markersize=6.0)
                axes.plot(floor.radius, floor.learned[:, side], color=colour(side), label=f"{name}, learned")
                axes.plot(floor.radius, floor.prior[:, side], ":", color=colour(side), label=f"{name}, from vinyl")
            for sign in (1, -1):
                axes.axhline(sign * floor.limit, color=REFERENCE_COLOUR, linewidth=0.8, linestyle="--")
            for k, (radius, name) in enumerate(((floor.learned_least, "learned"), (floor.own, "measured"))):
                if radius:
                    label = f"least radius, {name}: {radius:.2f} m"
                    axes.axvline(radius, color=colour(2 + k), linestyle=line_style(2 + k), label=label)
            axes.set(xscale="log", xlabel="commanded turn radius [m]", title=f"'{floor.floor}'")
            axes.set_ylim(-1.1 * floor.limit, 1.9 * floor.limit)
            axes.legend(loc="upper right", fontsize=7.0)
        shown[0].set_ylabel("torque of a side [N m]")


def draw_turn_energy(floors: Sequence[LearnedTurns], path: Path) -> None:
    """Draw the energy over one drive (figure 19), and what was missed on all (figure 25)."""
    first = floors[0].runs[0]
    with new_figure(path, 9.0, 3.6) as figure:
        left, right = figure.subplots(1, 2)
        for k, (values, name) in enumerate(
            ((first.measured, "measured"), (first.learned, "foreseen, learned"), (first.prior, "foreseen, vinyl"))
        ):
            shade = REFERENCE_COLOUR if not k else colour(k - 1)
            left.plot(first.time, values, line_style(k), color=shade, linewidth=1.4 if k else 3.0, label=name)
        left.set(xlabel="time [s]", ylabel="energy [J]", title=f"one drive on '{floors[0].floor}'")
        left.legend()
        place = 0
        for k, floor in enumerate(floors):
            places = place + np.arange(len(floor.runs))
            learned, prior = (
                [100 * run.missed(getattr(run, name)) for run in floor.runs] for name in ("learned", "prior")
            )
            right.bar(places - 0.5 * _BAR, learned, _BAR, color=colour(k), label=f"'{floor.floor}'")
            right.bar(places + 0.5 * _BAR, prior, _BAR, color=colour(k), alpha=0.35, hatch="//")
            place += len(floor.runs)
        right.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
        right.set_xticks(range(place), [str(k + 1) for k in range(place)])
        right.set(xlabel="drive", ylabel="measured less foreseen [%]", title="learned (full) and from vinyl (hatched)")
        right.grid(axis="x", visible=False)
        right.legend(loc="upper left", ncols=3, fontsize=7.0)
        right.margins(y=0.15)
