"""Figure of a run: path, errors and commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from diffdrive_mpc.models.errors import MissingPackageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REFERENCE: dict[str, Any] = {"color": "0.6", "linewidth": 3.0, "label": "reference"}


def plot_run(run: Any) -> Figure:  # noqa: ANN401 - a Run; importing its module would be circular
    """Plot path and reference, and over time the position and heading errors and the commands."""
    try:
        import matplotlib.pyplot as plt  # noqa: PLC0415 - loads slowly
    except ImportError as error:
        raise MissingPackageError("run.plot() needs matplotlib: pip install matplotlib") from error
    figure, axes = plt.subplot_mosaic(
        [["path", "position"], ["path", "heading"], ["path", "v"], ["path", "omega"]],
        figsize=(11.0, 6.5),
        layout="constrained",
    )
    figure.suptitle(repr(run))
    path = axes["path"]
    path.plot(*run.reference_pose[:, :2].T, **_REFERENCE)
    path.plot(*run.true_pose[:, :2].T, label="robot")
    path.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    path.legend()
    _draw(axes["position"], run, "error [mm]", position=1e3 * run.errors.position, lateral=1e3 * run.errors.lateral)
    _draw(axes["heading"], run, "error [rad]", heading=run.errors.heading)
    for i, (name, label) in enumerate((("v", "v [m/s]"), ("omega", "omega [rad/s]"))):
        axes[name].plot(run.time, run.reference_twist[:, i], **_REFERENCE)
        _draw(axes[name], run, label, command=run.command[:, i])
    axes["omega"].set_xlabel("t [s]")
    return figure


def _draw(axes: Any, run: Any, label: str, **lines: np.ndarray[Any, Any]) -> None:  # noqa: ANN401 - axes of matplotlib
    for name, values in lines.items():
        axes.plot(run.time, values, label=name)
    axes.set(ylabel=label)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
