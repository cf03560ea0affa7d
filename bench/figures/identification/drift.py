"""How fast a pose predicted from commands alone goes astray."""

from __future__ import annotations

from pathlib import Path

from diffdrive_mpc.bench.figure_style import colour, line_style, new_figure
from diffdrive_mpc.bench.identification.outcome import Outcome


def draw_drift(outcome: Outcome, path: Path) -> None:
    """Draw position and heading error over the horizon."""
    drift = outcome.poses.drift
    horizon = [entry.horizon for entry in drift]
    with new_figure(path, 7.4, 3.2) as figure:
        panels = figure.subplots(1, 2)
        quantities = {"position": "position error [m]", "heading": "heading error [rad]"}
        for axes, (name, label) in zip(panels, quantities.items(), strict=True):
            for k, (kind, words) in enumerate({"rmse": "RMSE", "mean": "mean"}.items()):
                errors = [getattr(entry, f"{name}_{kind}") for entry in drift]
                axes.plot(horizon, errors, marker="os"[k], color=colour(k), linestyle=line_style(k), label=words)
            axes.set(xlabel="time since the poses agreed [s]", ylabel=label, xlim=(0, None), ylim=(0, None))
        panels[0].legend()
        figure.suptitle(f"{outcome.name}: open-loop pose error on data held out")
