"""Table and figure of docs/nav2.md: Nav2's control law and this project's controller on the same robot and paths.

`python -m studies.documents.nav2_page` writes the table and the figure. Errors are distances from the path, because the
path of a FollowPath goal has no times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.figure_style import colour, line_style, new_figure
from diffdrive_mpc.models.interface import FloatArray, Reference, TrackingController
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc_extras.peers.rpp import RegulatedPurePursuit, load_parameters, path_of
from studies.documents.documents import format_machine, insert

PAGE = Path(__file__).resolve().parents[2] / "docs" / "nav2.md"
FIGURE = PAGE.parent / "nav2" / "paths.png"
MARKER = "side-by-side"
PATHS = ("circle", "s", "square", "cane")
SEEDS = range(5)
_EXTRA_TIME = 15.0
"""Maximum time of a run after the end of the reference [s]; Nav2's law drives more slowly than the reference."""
_REST_SPEED = 0.01
"""Maximum |v| [m/s] and |omega| [rad/s] of a robot at rest."""
_SPACING = 0.002
"""Distance of the points of the path for the evaluation [m]."""


@dataclass(frozen=True)
class PathRun:
    """Result of a run along a path.

    Attributes
    ----------
    distances
        Distances (n,) between the true position and the path at each tick [m].
    end_distance, heading_error
        Distance from the end of the path [m] and heading error [rad] of the robot at rest.
    time, speed
        Time until the robot is at rest [s], and mean speed until then [m/s].
    position
        Position (n, 2) of the robot [m].
    """

    distances: FloatArray
    end_distance: float
    heading_error: float
    time: float
    speed: float
    position: FloatArray


def short_look_ahead() -> TrackingController:
    """Create Nav2's control law with half its default look-ahead distance."""
    return RegulatedPurePursuit(parameters=load_parameters().model_copy(update={"lookahead_dist": 0.3}))


CONTROLLERS: dict[str, Callable[[], TrackingController]] = {
    "regulated pure pursuit, Nav2's defaults": RegulatedPurePursuit,
    "regulated pure pursuit, `lookahead_dist: 0.3`": short_look_ahead,
    "this project, `ssm`": lambda: Controller(load_config("ssm")),
}


def run_path(make_controller: Callable[[], TrackingController], reference: Reference, seed: int) -> PathRun:
    """Drive the simulated skid-steer robot along a path, with the default surface and sensors."""
    plant = make_plant("mujoco", surface="default", sensors="default", seed=seed)
    run = simulate(make_controller(), plant, reference, extra_time=_EXTRA_TIME)
    path = path_of(reference, _SPACING)
    moving_ticks = np.flatnonzero(np.abs(run.true_twist).max(axis=1) > _REST_SPEED)
    stop = int(moving_ticks[-1]) + 1
    position = run.true_pose[: stop + 1, :2]
    final_pose = run.true_pose[min(stop, len(run.true_pose) - 1)]
    travelled = float(np.hypot(*np.diff(position, axis=0).T).sum())
    return PathRun(
        _distances(position, path[:, :2]),
        float(np.hypot(*(final_pose - path[-1])[:2])),
        abs(float(np.angle(np.exp(1j * (final_pose[2] - path[-1, 2]))))),
        stop * run.sample_time,
        travelled / (stop * run.sample_time),
        position,
    )


def _distances(points: FloatArray, path: FloatArray) -> FloatArray:
    return np.array([np.hypot(*(path - point).T).min() for point in points])


def run_all() -> dict[tuple[str, str], list[PathRun]]:
    """Run every controller on every path with each seed."""
    results = {}
    for path in PATHS:
        reference = load_trajectory(path)
        for name, make_controller in CONTROLLERS.items():
            results[path, name] = [run_path(make_controller, reference, seed) for seed in SEEDS]
    return results


def table(results: dict[tuple[str, str], list[PathRun]]) -> str:
    """Tabulate the means over the seeds, and the maximum distance of all seeds, as Markdown."""
    lines = [
        "| path | controller | distance RMS [mm] | maximum [mm] | end [mm] | end [rad] | time [s] | speed [m/s] |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for (path, name), runs in results.items():
        rms = 1e3 * float(np.sqrt(np.mean(np.concatenate([run.distances for run in runs]) ** 2)))
        maximum = 1e3 * max(float(run.distances.max()) for run in runs)
        keys = ("end_distance", "heading_error", "time", "speed")
        mean = [float(np.mean([getattr(run, key) for run in runs])) for key in keys]
        lines.append(
            f"| {path} | {name} | {rms:.1f} | {maximum:.0f} | {1e3 * mean[0]:.0f} | {mean[1]:.3f} | {mean[2]:.1f} "
            f"| {mean[3]:.2f} |"
        )
    return "\n".join(lines)


def draw(results: dict[tuple[str, str], list[PathRun]], path: Path = FIGURE) -> None:
    """Draw the driven paths of the first seed."""
    path.parent.mkdir(exist_ok=True)
    with new_figure(path, 11.0, 3.2) as figure:
        axes = figure.subplots(1, len(PATHS))
        for axis, name in zip(axes, PATHS, strict=True):
            line = path_of(load_trajectory(name), 0.02)
            axis.plot(line[:, 0], line[:, 1], color="0.8", linewidth=4.0, label="path")
            for index, controller in enumerate(CONTROLLERS):
                xy = results[name, controller][0].position
                label = controller.replace("`", "")
                axis.plot(xy[:, 0], xy[:, 1], line_style(index), color=colour(index), linewidth=1.0, label=label)
            axis.set_title(name)
            axis.set_aspect("equal")
            axis.set_xlabel("x [m]")
        axes[0].set_ylabel("y [m]")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)


def main() -> None:
    """Write the table and the figure."""
    results = run_all()
    note = f"Means over {len(SEEDS)} seeds; the maximum distance is over all seeds; {format_machine()}"
    text = f"{table(results)}\n\n{note}"
    PAGE.write_text(insert(PAGE.read_text(encoding="utf-8"), text, MARKER), encoding="utf-8")
    draw(results)


if __name__ == "__main__":
    main()
