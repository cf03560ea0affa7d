"""A drive in the viewer Rerun, live or as a file: the robot, its plan, its reference, and the numbers over time."""

from __future__ import annotations

import csv
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import ControlStep, FloatArray, Measurement, Reference, TrackingController
from diffdrive_mpc.models.logs.drive_log.reader import read_drive_log
from diffdrive_mpc.models.logs.drive_log.tick import Cell, TickRow, decided_cells, error_cells, measured_cells, numbers
from diffdrive_mpc.models.path_times import path_times
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.plants.plant import Plant

LIVE = "live"
"""In place of a file: open the viewer."""
_GREY, _BLUE, _GREEN, _ORANGE = (0x80, 0x80, 0x80), (0x00, 0x72, 0xB2), (0x00, 0x9E, 0x73), (0xE6, 0x9F, 0x00)
_BODIES = {"true": _GREEN, "estimate": _BLUE, "pose": _ORANGE}
_RADIUS, _LENGTH = 0.0075, 0.25
_SCALARS = {
    "speed": ("v_ref_m_s", "v_wheel_m_s", "estimate_v_m_s", "true_v_m_s"),
    "yaw_rate": ("omega_ref_rad_s", "omega_gyro_rad_s", "estimate_omega_rad_s", "true_omega_rad_s"),
    "error": ("error_along_m", "error_across_m"),
    "time": ("step_time_s", "solve_time_s"),
}
"""Columns that are plotted, by the folder of entities that they share."""


class RerunView:
    """Shows ticks one after another.

    Parameters
    ----------
    stream
        A `rerun.RecordingStream`.
    """

    def __init__(self, stream: Any) -> None:  # noqa: ANN401 - rerun is optional
        import rerun  # noqa: PLC0415

        self._rerun, self._stream, self._said = rerun, stream, ("", "")
        rerun.send_blueprint(_blueprint(), recording=stream)
        stream.log("path", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def reference(self, poses: FloatArray) -> None:
        """Show the whole path (n, 2 or more) that is to be driven."""
        self._line("path/reference", poses, _GREY, static=True)

    def tick(self, row: TickRow, plan: FloatArray | None = None) -> None:
        """Show one tick: its row, by the names of a run's columns, and the plan (N + 1, 3)."""
        rerun, stream = self._rerun, self._stream
        stream.set_time("time", duration=float(row["t_s"]))
        row = {**row, **error_cells(row)}
        for name, colour in _BODIES.items():
            pose = numbers(row, (f"{name}_x_m", f"{name}_y_m", f"{name}_theta_rad"))
            if pose:
                ahead = [_LENGTH * math.cos(pose[2]), _LENGTH * math.sin(pose[2]), 0.0]
                shown = rerun.Arrows3D(origins=[[*pose[:2], 0.0]], vectors=[ahead], colors=[colour])
                stream.log(f"path/{name}", shown)
        if plan is not None and len(plan):
            self._line("path/plan", plan, _BLUE)
        for folder, names in _SCALARS.items():
            for name in names:
                if value := numbers(row, (name,)):
                    stream.log(f"{folder}/{name}", rerun.Scalars(value[0]))
        text = str(row["mode"]), str(row["message"])
        if text != self._said:
            self._said = text
            level = "INFO" if text[0] in ("TRACKING", "FINISHED") and not text[1] else "WARN"
            stream.log("mode", rerun.TextLog(": ".join(filter(None, text)), level=level))

    def _line(self, entity: str, poses: FloatArray, colour: tuple[int, int, int], *, static: bool = False) -> None:
        strip = [[float(pose[0]), float(pose[1]), 0.0] for pose in poses]
        shown = self._rerun.LineStrips3D([strip], colors=[colour], radii=[_RADIUS])
        self._stream.log(entity, shown, static=static)


class ShownController:
    """A controller, and the view of what it does with a plant."""

    def __init__(self, controller: TrackingController, plant: Plant, view: RerunView) -> None:
        self._controller, self._plant, self._view = controller, plant, view

    def start(self, reference: Reference, t0: float) -> None:
        """Pass on, and show the path."""
        self._controller.start(reference, t0)
        self._reference, self._t0 = reference, t0
        self._view.reference(reference.sample(path_times(reference.duration)).pose)

    def step(self, t: float, measurement: Measurement) -> ControlStep:
        """Pass on, and show what was said."""
        step = self._controller.step(t, measurement)
        row: dict[str, Cell] = {"t_s": t, **decided_cells(step), **measured_cells(measurement)}
        x, y, theta = self._plant.true_pose.tolist()
        v, _, omega = self._plant.true_twist.tolist()
        row |= {"true_x_m": x, "true_y_m": y, "true_theta_rad": theta, "true_v_m_s": v, "true_omega_rad_s": omega}
        tracked = self._reference.sample([t - self._t0]).pose[0].tolist()
        row |= zip(("reference_x_m", "reference_y_m", "reference_theta_rad"), tracked, strict=True)
        self._view.tick(row, step.plan)
        return step


def _blueprint() -> Any:  # noqa: ANN401 - rerun is optional
    """The path and what was said on the left, the numbers on the right."""
    import rerun.blueprint as views  # noqa: PLC0415

    numbers_over_time = [views.TimeSeriesView(origin=folder, name=folder.replace("_", " ")) for folder in _SCALARS]
    scene = views.Vertical(
        views.Spatial3DView(origin="path", name="path"), views.TextLogView(origin="mode"), row_shares=[4, 1]
    )
    return views.Blueprint(views.Horizontal(scene, views.Vertical(*numbers_over_time)), collapse_panels=True)


@contextmanager
def rerun_view(target: str, name: str) -> Iterator[RerunView]:
    """Open the viewer, or a file that appears in the end.

    Parameters
    ----------
    target
        `LIVE`, or the path of an .rrd file.
    name
        Of the recording.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the file cannot be written, or there is no display.
    ModuleNotFoundError
        Without the extra `rerun`.
    """
    import rerun  # noqa: PLC0415 - optional

    stream = rerun.RecordingStream(f"diffdrive-mpc {name}")
    if target == LIVE:
        if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise ConfigError("--rerun live: there is no display; give a file: --rerun run.rrd")
        stream.spawn()
        yield RerunView(stream)
        stream.flush()
        return
    if Path(target).suffix != ".rrd":
        raise ConfigError(f"--rerun {target}: give 'live', or a file that ends in .rrd")
    with whole_file(target) as draft:
        stream.save(draft)
        yield RerunView(stream)
        stream.flush()
        stream.disconnect()


def show_log(path: Path, target: str) -> int:
    """Show a log of a run; returns its number of ticks.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the log is none of ours, or as `rerun_view` does.
    """
    rows, plans = _logged(path)
    with rerun_view(target, path.stem) as view:
        tracked = [pose for row in rows if (pose := numbers(row, ("reference_x_m", "reference_y_m")))]
        if tracked:
            view.reference(np.array(tracked))
        for row, plan in zip(rows, plans, strict=True):
            view.tick(row, plan)
    return len(rows)


def _logged(path: Path) -> tuple[Sequence[TickRow], Sequence[FloatArray | None]]:
    """Rows and plans of a log."""
    if path.suffix == ".mcap":
        log = read_drive_log(path, plans=True)
        return log.rows, log.plans
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [_row(cells) for cells in csv.DictReader(file)]
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as a log ({getattr(error, 'strerror', None) or error})") from error
    if not rows or not {"t_s", "v_ref_m_s", "mode", "message"} <= set(rows[0]):
        raise ConfigError(f"{path}: is no log of `diffdrive-mpc simulate --log`, .csv or .mcap, nor of the node")
    return rows, [None] * len(rows)


_WORDS = ("mode", "message", "solver_status", "solver_path")


def _row(cells: Mapping[str, str]) -> TickRow:
    return {name: cell if name in _WORDS else float(cell) for name, cell in cells.items() if cell or name in _WORDS}
