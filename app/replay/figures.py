"""The figures of a replay; matplotlib is loaded when one is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.replay.open_loop import Replayed
from diffdrive_mpc.app.replay.recording import Recording
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.models.logs.record import BoolArray


def draw_path(
    recording: Recording, replayed: Replayed, references: Sequence[Reference], counted: BoolArray, path: Path
) -> None:
    """Poses as they came, what the estimator made of them, and what was tracked."""
    from diffdrive_mpc.bench.figure_style import REFERENCE_COLOUR, colour, new_figure  # noqa: PLC0415 - loads slowly

    came = [
        np.asarray(tick.measurement.pose.value, dtype=float)[:2]
        for tick, keep in zip(recording.ticks, counted, strict=True)
        if keep and tick.measurement.pose is not None
    ]
    with new_figure(path, 6.0, 6.0) as figure:
        axes = figure.subplots()
        for i, reference in enumerate(references):
            line = reference.sample(np.linspace(0.0, reference.duration, 1000)).pose
            label = "reference" if i == 0 else None
            axes.plot(line[:, 0], line[:, 1], color=REFERENCE_COLOUR, linewidth=3.0, alpha=0.5, label=label)
        if came:
            axes.plot(*np.array(came).T, ".", color=colour(4), markersize=2.0, label="poses")
        axes.plot(replayed.estimate[counted, 0], replayed.estimate[counted, 1], color=colour(0), label="estimate")
        axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axes.legend()
