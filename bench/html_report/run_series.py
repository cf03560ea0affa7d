"""Charts of a closed-loop run: path, errors, commands, step time, and the methods and modes over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.html_report.page import Labels, Mark, RunSeries, Series
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.metrics import FALLBACK_MODES

HOW_TO_READ = "Hovering over one view marks the same time in the other view"
PEAKS = "Of every group of adjacent ticks, only the tick with the maximum position error is drawn"
ERROR, HEADING, STEP, METHOD = "error [mm]", "heading error [mrad]", "step time [ms]", "solver or mode"
TWIST = ("v [m/s]", "omega [rad/s]")
_NEAR_LIMIT = 0.1
"""Share of a limit that a command must exceed for the limit to be drawn; a distant limit would compress the curves."""


def run_series(
    run: Run,
    name: str,
    *,
    points: int,
    labels: Labels | None = None,
    style: int = 0,
    config: ControllerConfig | None = None,
) -> RunSeries:
    """Build the series of a run.

    Parameters
    ----------
    run
        The run.
    name
        Name in the legend of a run that is compared with others.
    points
        Maximum number of ticks.
    labels
        Values of the toggles, by toggle, for a run that is compared with others; runs with the same value of "path"
        share a reference. None for a single run, whose charts also show the estimate, the measured poses, the true
        twist, the error along the path, and the limits of `config`.
    style
        Index of the style of a compared run.
    config
        Configuration of the controller; None for a peer.
    """
    single, labels, ticks = labels is None, labels or {}, select_ticks(run, points)
    reference_labels = {"path": labels["path"]} if "path" in labels else {}
    time = rounded_list(run.time[ticks], 3)

    def line(title: str, x: Sequence[float | None], values: FloatArray, digits: int, number: int = 0) -> Series:
        legend = (title, number) if single else (name, style)
        return Series(legend[0], x, rounded_list(values, digits), legend[1], "line", labels=labels, group=name)

    def reference(x: Sequence[float | None], values: FloatArray) -> Series:
        return Series("reference", x, rounded_list(values, 3), kind="reference", labels=reference_labels)

    def xy_line(title: str, xy: FloatArray, number: int = 0) -> Series:
        return line(title, rounded_list(xy[:, 0], 3), xy[:, 1], 3, number)

    errors, pose = run.errors, run.reference_pose[ticks]
    plane = [reference(rounded_list(pose[:, 0], 3), pose[:, 1]), xy_line("driven", run.true_pose[ticks])]
    panes = {
        ERROR: [line("lateral", time, 1e3 * errors.lateral[ticks], 1)],
        HEADING: [line("heading", time, 1e3 * errors.heading[ticks], 1)],
        **{
            title: [
                reference(time, run.reference_twist[ticks, channel]),
                line("command", time, run.command[ticks, channel], 3, 1),
            ]
            for channel, title in enumerate(TWIST)
        },
        STEP: [line("step time", time, 1e3 * run.step_time[ticks], 3, 1)],
        METHOD: [_method_series(run, name, labels, 1 if single else style)],
    }
    marks = {}
    if single:
        plane += [xy_line("estimate", run.estimates[ticks], 2)] if np.isfinite(run.estimates[:, 0]).any() else []
        poses = run.measured_pose[np.isfinite(run.measured_pose[:, 0])][:: max(1, len(run.time) // points)]
        xy = (rounded_list(poses[:, 0], 3), rounded_list(poses[:, 1], 3))
        plane = [*([Series("received poses", *xy, 3, "points")] if len(poses) else []), *plane]
        offset, heading = run.true_pose - run.reference_pose, run.reference_pose[:, 2]
        ahead = offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading)
        panes[ERROR] += [line("along", time, 1e3 * ahead[ticks], 1, 4)]
        for channel, title in enumerate(TWIST):
            panes[title] += [line("true", time, run.true_twist[ticks, (0, 2)[channel]], 3)]
        marks = {} if config is None else _limits(run, config)
    return RunSeries(name, plane, panes, marks)


def select_ticks(run: Run, points: int) -> NDArray[np.intp]:
    """Select at most `points` ticks of a run: in every group of adjacent ticks, the tick with the maximum error."""
    count = len(run.time)
    groups = np.array_split(np.arange(count), min(points, count))
    error = np.nan_to_num(run.errors.position)
    return np.array([ticks[np.argmax(error[ticks])] for ticks in groups], dtype=np.intp)


def rounded_list(values: FloatArray, digits: int) -> list[float | None]:
    """Round numbers to `digits` decimal places; a number that is not finite becomes None."""
    return [float(value) if np.isfinite(value) else None for value in np.round(values, digits)]


def _method_series(run: Run, name: str, labels: Labels, style: int) -> Series:
    """Build a step series of the solver's method, or of the state during a fallback or a lag and at the end."""
    special = {*FALLBACK_MODES, "FINISHED", "LATE"}
    values = [
        state if state in special else method for state, method in zip(run.states, run.solver_methods, strict=True)
    ]
    changes = [k for k in range(len(values)) if k == 0 or values[k] != values[k - 1]]
    time = rounded_list(run.time[[*changes, len(values) - 1]], 3)
    return Series(name, time, [values[k] for k in (*changes, len(values) - 1)], style, "steps", labels=labels)


def _limits(run: Run, config: ControllerConfig) -> dict[str, list[Mark]]:
    limits = zip(TWIST, run.command.T, (config.limits.v, config.limits.omega), strict=True)
    return {
        title: [
            Mark(sign * side, "limit")
            for sign, side in zip((-1, 1), reversed(limit.sides), strict=True)
            if (sign * command > _NEAR_LIMIT * side).any()
        ]
        for title, command, limit in limits
    }
