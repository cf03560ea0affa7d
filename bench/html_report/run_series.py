"""A closed-loop run as the page shows it: columns rounded and thinned, and spans of time for modes and solver paths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from diffdrive_mpc.bench.html_report.page import Labels
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.sim import Run
from diffdrive_mpc.sim.metrics.metrics import FALLBACK_MODES

HOW_TO_READ = (
    "Point at either view, or move the slider: the other shows the same time, the readout what happened then. "
    "Thick in the strip: more trouble"
)
PEAKS = "Of neighbouring ticks the one with the largest position error is drawn"
_PLAN_POINTS, _MESSAGES = 12, 40
# Steps of the last digit that is kept, in the units that the page shows.
_POSITION, _ANGLE, _ERROR, _TWIST, _TIME, _STEP = 1e-3, 1e-2, 1e-1, 1e-3, 1e-3, 1e-3


def run_series(
    run: Run,
    name: str,
    *,
    points: int,
    labels: Labels | None = None,
    style: int = 0,
    config: ControllerConfig | None = None,
    every_layer: bool = True,
) -> dict[str, object]:
    """Everything that the page shows of a run.

    Parameters
    ----------
    run
        The run.
    name
        In the readout.
    points
        How many ticks are kept at most.
    labels
        Toggles that hide it; the value of "path" says which runs share a reference.
    style
        Number of its colour and line.
    config
        Of its controller, for the limits of the commands; None for a peer.
    every_layer
        Whether estimate, poses and true twist are kept, which comparisons do without.
    """
    kept = kept_ticks(run, points)
    columns = _columns(run, kept) | (_more_columns(run, kept, points) if every_layer else {})
    layers = ["reference", "along", *(["twist"] if every_layer else [])]
    layers += [layer for layer, column in (("estimate", "estimate_x"), ("poses", "pose_x")) if column in columns]
    limits = {} if config is None else {"limit_v": config.limits.v, "limit_omega": config.limits.omega}
    plans = _plans(run, kept) if every_layer and len(run.plans) else None
    labels = labels or {}
    return {
        "name": name,
        "labels": labels,
        "path": labels.get("path", ""),
        "style": style,
        "columns": columns,
        "layers": [*layers, *(["limits"] if limits else []), *(["plan"] if plans else [])],
        "strip": spans(run, _troubles(run)),
        "paths": spans(run, run.solver_methods),
        "modes": spans(run, run.modes),
        "messages": _messages(run),
        "plans": plans,
        **limits,
    }


def kept_ticks(run: Run, points: int) -> NDArray[np.intp]:
    """At most `points` ticks of a run: of neighbours the one with the largest position error, so that peaks stay."""
    count = len(run.time)
    groups = np.array_split(np.arange(count), min(points, count))
    error = np.nan_to_num(run.errors.position)
    return np.array([ticks[np.argmax(error[ticks])] for ticks in groups], dtype=np.intp)


def along_error(run: Run) -> FloatArray:
    """(n,) how far the robot is ahead of its reference, along the reference's heading [m]."""
    offset, heading = run.true_pose - run.reference_pose, run.reference_pose[:, 2]
    return np.asarray(offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading))


def column(values: FloatArray, step: float) -> dict[str, object]:
    """Numbers as whole multiples of `step`, which are short; what is not finite is null."""
    whole = np.rint(np.asarray(values, dtype=float) / step)
    return {"s": step, "v": [int(one) if math.isfinite(one) else None for one in whole]}


def spans(run: Run, words: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """By word, from when to when it stood [s]."""
    stretches: dict[str, list[tuple[float, float]]] = {}
    first = 0
    for word, ticks in groupby(words):
        last = first + len(list(ticks))
        end = run.time[min(last, len(run.time) - 1)]
        stretches.setdefault(word, []).append((round(float(run.time[first]), 3), round(float(end), 3)))
        first = last
    return stretches


def _columns(run: Run, kept: NDArray[np.intp]) -> dict[str, object]:
    errors, reference = run.errors, run.reference_pose
    return {
        "t": column(run.time[kept], _TIME),
        "x": column(run.true_pose[kept, 0], _POSITION),
        "y": column(run.true_pose[kept, 1], _POSITION),
        "theta": column(run.true_pose[kept, 2], _ANGLE),
        "reference_x": column(reference[kept, 0], _POSITION),
        "reference_y": column(reference[kept, 1], _POSITION),
        "reference_v": column(run.reference_twist[kept, 0], _TWIST),
        "reference_omega": column(run.reference_twist[kept, 1], _TWIST),
        "lateral": column(1e3 * errors.lateral[kept], _ERROR),
        "along": column(1e3 * along_error(run)[kept], _ERROR),
        "heading": column(1e3 * errors.heading[kept], _ERROR),
        "v": column(run.command[kept, 0], _TWIST),
        "omega": column(run.command[kept, 1], _TWIST),
        "step": column(1e3 * run.step_time[kept], _STEP),
    }


def _more_columns(run: Run, kept: NDArray[np.intp], points: int) -> dict[str, object]:
    more: dict[str, object] = {
        "true_v": column(run.true_twist[kept, 0], _TWIST),
        "true_omega": column(run.true_twist[kept, 2], _TWIST),
    }
    if np.isfinite(run.estimates[:, 0]).any():
        more["estimate_x"] = column(run.estimates[kept, 0], _POSITION)
        more["estimate_y"] = column(run.estimates[kept, 1], _POSITION)
    poses = run.measured_pose[np.isfinite(run.measured_pose[:, 0])]
    if len(poses):
        poses = poses[:: math.ceil(len(poses) / points)]
        more["pose_x"], more["pose_y"] = column(poses[:, 0], _POSITION), column(poses[:, 1], _POSITION)
    return more


def _troubles(run: Run) -> list[str]:
    """At each tick the mode where the controller did without a fresh plan or had finished, else the solver's path."""
    telling = {*FALLBACK_MODES, "FINISHED"}
    return [mode if mode in telling else path for mode, path in zip(run.modes, run.solver_methods, strict=True)]


def _messages(run: Run) -> list[tuple[float, str]]:
    """When the controller began to say what."""
    first = [k for k in range(len(run.messages)) if k == 0 or run.messages[k] != run.messages[k - 1]]
    return [(round(float(run.time[k]), 3), run.messages[k]) for k in first[:_MESSAGES]]


def _plans(run: Run, kept: NDArray[np.intp]) -> list[list[list[float]] | None]:
    """X and y [m] of some points of the plan at each kept tick; None where there was none."""
    length = run.plans.shape[1]
    chosen = np.unique(np.linspace(0, length - 1, min(length, _PLAN_POINTS)).round().astype(int))
    plans = run.plans[kept][:, chosen, :2]
    return [plan.round(3).tolist() if np.isfinite(plan).all() else None for plan in plans]
