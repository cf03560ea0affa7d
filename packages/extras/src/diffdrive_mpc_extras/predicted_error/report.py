"""Report of `diffdrive-mpc predict-error`: table, figure and rows of a predicted tracking error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.runner import available_cores
from diffdrive_mpc.bench.table import Table, millis
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import Reference
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.mpc import Controller, load_config, load_trajectory
from diffdrive_mpc_extras.campaign.own_plant import own_plant
from diffdrive_mpc_extras.predicted_error.calibration import Direction
from diffdrive_mpc_extras.predicted_error.drives import DRAWS, check_count, predict_by_drives, scale_by_logs
from diffdrive_mpc_extras.predicted_error.predicted_error import PredictedError, predict_error

FIGURE, ROWS = "predicted-error.png", "predicted-error.csv"
_DIRECTIONS: tuple[Direction, ...] = ("lateral", "along")
_GREYS = ("0.85", "0.6")
"""Grey levels of both tubes, distinguishable in print."""


def predict_robot_into(
    config: str,
    trajectory: str,
    plant: str | None,
    out: Path,
    draws: int = DRAWS,
    jobs: int | None = None,
    logs: Sequence[Path] = (),
) -> PredictedError:
    """Predict the error from simulated drives on a plant, by default `own_plant`, and write it with `write_prediction`.

    If `logs` of recorded drives are given, `scale_by_logs` scales the tubes.

    Raises ConfigError or ValueError if a name is unknown, a file is invalid, no plant belongs to the configuration, or
    the trajectory is not drivable; OSError if `out` is not writable.
    """
    checked_reference(config, trajectory)
    plant, jobs = plant or own_plant(config), jobs or available_cores()
    if missing := [log for log in logs if not log.exists()]:
        raise ConfigError(f"--learn-from {missing[0]}: there is no such file; give a log of simulate or of the node")
    check_count(logs)
    with ProgressBar("driving", draws, lines=True) as bar:
        predicted = predict_by_drives(config, trajectory, plant, draws, jobs, bar.advance)
    if logs:
        predicted = scale_by_logs(logs, predicted, load_config(config), plant, draws, jobs)
    return write_prediction(predicted, out)


def predict_population_into(
    config: str, trajectory: str, population: str, out: Path, calibration: Path | None = None
) -> PredictedError:
    """Predict the error for a population, and write it; errors as in `predict_error`, and OSError for `out`."""
    return write_prediction(predict_error(*checked_reference(config, trajectory), population, calibration), out)


def checked_reference(config: str, trajectory: str) -> tuple[Controller, Reference]:
    """Return controller and reference; raise ConfigError or ValueError if the reference is not drivable."""
    loaded = load_config(config)
    controller = Controller(loaded)
    return controller, controller.checked_reference(load_trajectory(trajectory, loaded))


def write_prediction(predicted: PredictedError, out: Path) -> PredictedError:
    """Print widths, widest places and warnings, and write figure and rows into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    with whole_file(out / ROWS) as draft:
        write_rows(predicted, draft)
    draw(predicted, out / FIGURE)
    console = output_console()
    console.print(table(predicted).rich())
    for direction in _DIRECTIONS:
        console.print(predicted.widest(direction).sentence, highlight=False, markup=False, soft_wrap=True)
    if predicted.warnings:
        console.print(f"warning: {'; '.join(predicted.warnings)}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"figure: {out / FIGURE}; rows: {out / ROWS}", highlight=False, markup=False, soft_wrap=True)
    return predicted


def table(predicted: PredictedError) -> Table:
    """Return a table with mean and maximum half width of each tube."""
    rows = []
    for direction in _DIRECTIONS:
        tube = getattr(predicted, direction)
        widths = (tube.at_each_place, tube.everywhere)
        rows.append((direction, *(millis(statistic(width)) for width in widths for statistic in (np.mean, np.max))))
    columns = ("direction", "at each place, mean [mm]", "maximum [mm]", "everywhere, mean [mm]", "maximum [mm]")
    share = f"{100 * predicted.level:g} %"
    note = f"Half widths that contain {share} of drives: at each place, or everywhere. Drives: {predicted.drives}."
    return Table(f"Predicted error of '{predicted.reference}'", columns, tuple(rows), text_columns=1, note=note)


def write_rows(predicted: PredictedError, path: Path) -> None:
    """Write a CSV row for each place, in SI units."""
    head = "t,s,x,y,theta,v,omega,lateral,lateral_everywhere,along,along_everywhere"
    tubes = [width for tube in (predicted.lateral, predicted.along) for width in (tube.at_each_place, tube.everywhere)]
    columns = [predicted.time, predicted.arc_length, predicted.pose, predicted.twist, *tubes]
    np.savetxt(path, np.column_stack(columns), fmt="%.6g", delimiter=",", header=head, comments="")


def draw(predicted: PredictedError, path: Path) -> None:
    """Draw the path with its widest places, both tubes, and the twist of the reference over the arc length."""
    from diffdrive_mpc.bench.figure_style import MARKERS, REFERENCE_COLOUR, new_figure  # noqa: PLC0415 - loads slowly

    s = predicted.arc_length
    with new_figure(path, 9.0, 6.0) as figure:
        panels = figure.subplot_mosaic([["path", "lateral"], ["path", "along"], ["path", "twist"]])
        panels["path"].plot(*predicted.pose[:, :2].T, color="black")
        panels["path"].set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        figure.suptitle(f"Predicted error of {predicted.reference}: tubes with {100 * predicted.level:g} % of drives")
        for direction, marker in zip(_DIRECTIONS, MARKERS, strict=False):
            axes, tube, widest = panels[direction], getattr(predicted, direction), predicted.widest(direction).index
            for width, grey, label in zip(
                (tube.everywhere, tube.at_each_place), _GREYS, ("everywhere", "at each place"), strict=True
            ):
                axes.fill_between(s, -1e3 * width, 1e3 * width, color=grey, label=label, linewidth=0.0)
            axes.plot(s[widest], 1e3 * tube.everywhere[widest], marker, color="black", label="worst")
            axes.set(ylabel=f"{direction} [mm]")
            panels["path"].plot(*predicted.pose[widest, :2], marker, color="black", label=f"worst {direction}")
        panels["lateral"].legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels["path"].legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        panels["twist"].plot(s, predicted.twist[:, 0], color="black", label="v [m/s]")
        panels["twist"].plot(s, predicted.twist[:, 1], "--", color=REFERENCE_COLOUR, label="omega [rad/s]")
        panels["twist"].set(xlabel="distance along the path [m]")
        panels["twist"].legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
