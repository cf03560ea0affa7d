"""Draw every figure of an identification into a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from diffdrive_mpc.bench.figures.identification.drift import draw_drift
from diffdrive_mpc.bench.figures.identification.dynamics import draw_poles, draw_steps
from diffdrive_mpc.bench.figures.identification.orders import draw_orders
from diffdrive_mpc.bench.figures.identification.residuals import draw_residuals
from diffdrive_mpc.bench.figures.identification.simulation import draw_simulation
from diffdrive_mpc.models.identification.report import Outcome

Draw = Callable[[Outcome, Path], None]


def draw_identification(outcome: Outcome, folder: Path, on_done: Callable[[], None]) -> dict[str, str]:
    """Draw the figures; `on_done` is called after each.

    Returns
    -------
    dict
        Title and name of each file, in the order to be shown.
    """
    jobs = figures_of(outcome)
    for name, draw in jobs.values():
        draw(outcome, folder / name)
        on_done()
    return {title: name for title, (name, _) in jobs.items()}


def figures_of(outcome: Outcome) -> dict[str, tuple[str, Draw]]:
    """Title, file name and drawing function of each figure that this outcome has something for."""
    jobs: dict[str, tuple[str, Draw]] = {
        "Measured against simulated": ("simulation.png", draw_simulation),
        "What residuals still hold": ("residuals.png", draw_residuals),
        "Step responses": ("steps.png", draw_steps),
        "Poles": ("poles.png", draw_poles),
    }
    if outcome.fitted.orders:
        jobs["Orders of SSM"] = ("orders.png", draw_orders)
    if outcome.poses.drift:
        jobs["Drift of the pose"] = ("drift.png", draw_drift)
    return jobs
