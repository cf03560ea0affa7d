"""Simulation of one run of a campaign: build its parts, and check the commands of the controller."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from threadpoolctl import threadpool_limits

from diffdrive_mpc.bench.case import Overrides
from diffdrive_mpc.bench.controllers import build, settings_of
from diffdrive_mpc.bench.peers import PEERS
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.run_row import CLOCK, run_columns
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import ControlStep, Measurement, Reference, TrackingController
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.models.trust import UntrustedFileError, also_trusted
from diffdrive_mpc.models.whole_file import named_errors
from diffdrive_mpc.mpc.config.config_file import config_path
from diffdrive_mpc.mpc.solver.report import SolverStatus
from diffdrive_mpc.mpc.step_result import Mode
from diffdrive_mpc.sim import Plant, Run, simulate
from diffdrive_mpc.sim.plants.simulated_robot import DEFAULT, ROBOTS, load_simulated_robot
from diffdrive_mpc.sim.plants.surface import SURFACES
from diffdrive_mpc.sim.sensing.sensor_set import SENSOR_SETS
from diffdrive_mpc_extras.campaign.command_check import Unsafe, check_commands, stated_limits
from diffdrive_mpc_extras.campaign.definition import Definition

# Row of a run: metrics, completion, counts of modes and solver statuses, unsafe commands, and times.


TIME = "time_"
"""Prefix of the columns that differ when a run is repeated."""
_STATUS_COLUMNS = {str(status): f"solver_{status.name.lower()}" for status in SolverStatus}

Row = dict[str, bool | int | float | str | None]


def row_of(run: Run | None, unsafe: Unsafe | None, error: str, processor: float, wall: float) -> Row:
    """Build the row of one run.

    Parameters
    ----------
    run
        Simulated run; None if it ended in an error.
    unsafe
        Counts of unsafe commands; None for a peer.
    error
        Error of the run in one line; empty if there was no error.
    processor, wall
        Processor time and clock time of the run [s].
    """
    row: Row = {"completed": run is not None and run.metrics.completed, "error": error}
    row |= {f"unsafe_{name}": count for name, count in (asdict(unsafe) if unsafe else {}).items()}
    row |= {f"{TIME}processor_s": processor, f"{TIME}wall_s": wall}
    if run is None:
        return row
    for name, value in plain(run_columns(run)).items():
        row[f"{TIME}{name.replace('_time', '')}" if name.startswith(CLOCK) else name] = value
    modes, statuses = Counter(run.modes), Counter(run.solver_statuses)
    row |= {f"ticks_{mode.lower()}": modes[mode] for mode in Mode}
    return row | {column: statuses[status] for status, column in _STATUS_COLUMNS.items()}


OnTick = Callable[[int, int], None]
_PHYSICS = "mujoco"


class RecordedController:
    """Controller that records its commands, including commands rejected by the simulation loop."""

    def __init__(self, controller: TrackingController) -> None:
        self._controller = controller
        self.times: list[float] = []
        self.commands: list[tuple[float, float]] = []
        self.modes: list[str] = []
        self.has_pose: list[bool] = []

    def start(self, reference: Reference, t0: float) -> None:
        """Start the wrapped controller."""
        self._controller.start(reference, t0)

    def step(self, t: float, measurement: Measurement) -> ControlStep:
        """Step the wrapped controller, and record the command."""
        step = self._controller.step(t, measurement)
        pose = measurement.pose
        values = np.asarray(step.command, dtype=float).ravel()
        self.times.append(t)
        self.commands.append((float(values[0]), float(values[1])) if values.size == 2 else (np.nan, np.nan))
        self.modes.append(str(step.mode))
        self.has_pose.append(pose is not None and bool(np.isfinite(pose.value).all()))
        return step

    def unsafe(self, definition: Definition) -> Unsafe | None:
        """Count the unsafe commands; None for a peer, which has no stated limits."""
        case = definition.case
        if case.controller in PEERS or not self.times:
            return None
        config = case.config or (case.model if is_shipped(case.model) else "ssm")
        limits = stated_limits(config_path(config), dict(settings_of(case)))
        return check_commands(self.times, self.commands, self.modes, self.has_pose, limits)


@contextmanager
def built(definition: Definition) -> Iterator[tuple[TrackingController, Plant, Reference]]:
    """Yield controller, plant and reference of a run.

    Raises ConfigError or ValueError if a name is unknown, or if a file or a replacing value is invalid.
    """
    with TemporaryDirectory(prefix="diffdrive-mpc-") as folder, also_trusted(Path(folder)):
        yield build(_with_files(definition, Path(folder)))


def drive(definition: Definition) -> Row:
    """Simulate a run and return its row; an error of the run is stored in the column `error`."""
    return drive_run(definition)[1]


def drive_run(
    definition: Definition, on_tick: OnTick | None = None, *, keep_plans: bool = False
) -> tuple[Run | None, Row]:
    """Simulate a run; return the run and its row. `on_tick` and `keep_plans` are as in `sim.simulate`."""
    start, processor = time.perf_counter(), time.process_time()
    run: Run | None = None
    recorded: RecordedController | None = None
    error = ""
    with threadpool_limits(limits=1):
        try:
            with built(definition) as (controller, plant, reference):
                recorded = RecordedController(controller)
                run = simulate(recorded, plant, reference, keep_plans=keep_plans, on_tick=on_tick)
                _ = run.errors
        except (MemoryError, OSError, UntrustedFileError):
            raise  # not an error of the run itself, so that it can be repeated
        except Exception as fault:
            error = f"{type(fault).__name__}: {' '.join(str(fault).split())}"
        unsafe = recorded.unsafe(definition) if recorded else None
        return run, row_of(run, unsafe, error, time.process_time() - processor, time.perf_counter() - start)


def _with_files(definition: Definition, folder: Path) -> Any:  # noqa: ANN401 - a Case
    """Write the files with replaced values into `folder`, and return the case with these files."""
    case = definition.case
    if definition.robot:
        kind, _, name = case.plant.partition(":")
        if kind != _PHYSICS:
            raise ConfigError(
                f"robot.{definition.robot[0][0]}: the plant '{case.plant}' has no robot file; use 'mujoco'"
            )
        base = ROBOTS.read(name)[0] if name else {}
        robot_data = _replace_values({"description": "drawn by a campaign"} | base, definition.robot)
        case = replace(case, plant=f"{_PHYSICS}:{_write_yaml(robot_data, folder / 'robot.yaml')}")
    # A robot file may define the default friction and sensors; the values replace those of the robot file.
    kind, _, name = case.plant.partition(":")
    robot = load_simulated_robot(name) if kind == _PHYSICS and name else None
    if definition.surface:
        base = SURFACES.read(case.surface)[0]
        if robot and robot.friction and case.surface == DEFAULT:
            base = base | {"friction": robot.friction}
        case = replace(case, surface=_write_yaml(_replace_values(base, definition.surface), folder / "surface.yaml"))
    if definition.sensors:
        base = SENSOR_SETS.read(case.sensors)[0]
        if robot and case.sensors == DEFAULT:
            base = robot.sensors.model_dump(mode="json")
        case = replace(case, sensors=_write_yaml(_replace_values(base, definition.sensors), folder / "sensors.yaml"))
    return case


def _replace_values(data: Mapping[str, Any], values: Overrides) -> dict[str, Any]:
    changed = dict(data)
    for key, value in values:
        first, dot, rest = key.partition(".")
        inner = changed.get(first)
        changed[first] = (
            _replace_values(inner if isinstance(inner, Mapping) else {}, ((rest, value),)) if dot else value
        )
    return changed


def _write_yaml(data: Mapping[str, Any], path: Path) -> str:
    with named_errors(path):
        path.write_text(yaml.safe_dump(dict(data)), encoding="utf-8")
    return str(path)
