"""Excitation drive for the identification of a model: search, simulation on the expected robot, and log on a plant."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.run_log import includes_plans, run_log
from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.controllers import build_plant, controller_config, make_controller
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.identification.settings import identification_settings
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.load import is_shipped, load_linear_model
from diffdrive_mpc.models.output_error.parameters import ParameterEstimate
from diffdrive_mpc.models.velocity_model import CHANNELS, VelocityModel
from diffdrive_mpc.mpc import ControllerConfig, load_config, load_trajectory
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits, load_settings
from diffdrive_mpc.sim import Run, simulate
from diffdrive_mpc_extras.excitation.drive_information import REPORTED, DriveInformation
from diffdrive_mpc_extras.excitation.model_excitation import (
    ModelDrive,
    Room,
    evaluated_drives,
    model_excitation,
    model_excitation_settings,
    write_model_drive,
)

_LATE = "lag and dead time"


@dataclass(frozen=True)
class Excitation:
    """Excitation drive and its expected information.

    Attributes
    ----------
    case
        Controller with the room as fence; `on` sets trajectory and plant.
    room
        Room of the drive.
    drive
        Twists of the reference.
    expected
        Model parameters of the configuration, with their expected uncertainty after an identification from the drive.
    """

    case: Case
    room: Room
    drive: ModelDrive
    expected: ParameterEstimate

    def write(self, path: Path) -> None:
        """Write the trajectory file; raise ConfigError if it cannot be written."""
        write_model_drive(path, self.drive, model_excitation_settings().tick)

    def on(self, plant: str, seed: int, trajectory: Path) -> Case:
        """Build the case of a trajectory file on a plant, with the room as fence."""
        return replace(self.case, plant=plant, seed=seed, trajectory=str(trajectory))

    def lines(self, out: Path) -> list[str]:
        """Describe the result and the fence settings of the node's configuration."""
        seconds = len(self.drive.twists) * model_excitation_settings().tick
        worse = min(self.drive.objectives.values())
        better = np.exp((max(self.drive.objectives.values()) - worse) / (2 * len(CHANNELS) * len(REPORTED)))
        return [
            f"{out}: {self.drive.family}, {seconds:.0f} s. Standard deviations from the other family are {better:.2f} "
            "times as large (geometric mean).",
            "For the node: start the robot in the middle of the room, heading along its length; configuration:",
            f"fence: {{enabled: true, length: {self.room.length:g}, width: {self.room.width:g}, frame: start}}",
        ]

    def table(self) -> Table:
        """Return a table of the expected accuracy of the parameters."""
        shown = self.expected.derived(
            [f"{channel}.{name}" for channel in CHANNELS for name in (*REPORTED, _LATE)],
            lambda values: np.concatenate([[*levels, levels[1] + levels[2]] for levels in values.reshape(2, -1)]),
        )
        rows = []
        for name, *numbers in shown.rows:
            channel, parameter = name.split(".")
            unit, scale, digits = ("-", 1.0, 4) if parameter == "gain" else ("ms", 1e3, 2)
            cells = (number(scale * float(value), digits) for value in numbers)
            rows.append((channel, f"{parameter.replace('_', ' ')} [{unit}]", *cells))
        return Table(
            "Expected accuracy of the identified parameters",
            ("channel", "parameter", "expected value", "standard deviation"),
            tuple(rows),
            2,
            f"From the first {100 * identification_settings().fit_share:.0f} % of the rows, which `identify` fits, and "
            "the configured noise of encoders and gyro.",
        )


def excite_model(
    config: str,
    room: Room,
    *,
    seconds: float = 60.0,
    speed: float = 0.6,
    yaw_rate: float = 1.0,
    seed: int = 0,
    on_drive: Callable[[int, int], None] | None = None,
) -> Excitation:
    """Search for the drive with the most information about gains, lags and dead times of a configuration's robot.

    Parameters
    ----------
    config
        Configuration of the controller: a file, or the name of a model with a shipped configuration.
    room
        Room of the drive, which starts in the middle and heads along the length.
    seconds
        Duration of the drive [s].
    speed, yaw_rate
        Maximum speed [m/s] and yaw rate [rad/s].
    seed
        Seed of the search and of the noise in the simulation.
    on_drive
        Progress callback with the number of evaluated drives and the total number.

    Raises
    ------
    models.checked_yaml.ConfigError, models.velocity_model.ModelError
        If the configuration does not exist, its model is not linear, the speed or yaw rate exceeds the limits, or room
        or time do not suffice.
    """
    case = in_room(config, room)
    loaded = controller_config(case.model, case.config)
    margin = model_excitation_settings().margin
    if loaded.fence.margin >= margin:
        raise ConfigError(
            f"fence.margin = {loaded.fence.margin:g} m: the drive keeps {margin:g} m from the edges of the room, so the"
            f" fence would stop it; give less than {margin:g} m"
        )
    model = _controller_model(loaded)
    estimator = loaded.estimator
    information = DriveInformation(model, (estimator.wheel_speed_noise, estimator.yaw_rate_noise))
    tick = model_excitation_settings().tick
    each = max(1, round(tick / loaded.sample_time))

    evaluations, total = itertools.count(1), evaluated_drives()

    def objective(twists: FloatArray) -> float:
        if on_drive:
            on_drive(min(next(evaluations), total), total)
        return information.log_determinant(np.repeat(twists, each, axis=0), tick / each)

    drive = model_excitation(room, seconds, _limits(loaded, speed, yaw_rate), objective, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.yaml"
        write_model_drive(path, drive, tick)
        dead_time = float(np.mean([loaded.extra_dead_time.v, loaded.extra_dead_time.omega]))
        plant = f"model:{loaded.model}" + (f"+{dead_time:g}" if dead_time else "")
        run = simulate_case(replace(case, plant=plant, seed=seed), path)
    rows = round(identification_settings().fit_share * len(run.command))
    return Excitation(case, room, drive, information.parameters(run.command[:rows], run.sample_time))


def excite_into(
    config: str,
    room: Room,
    out: Path,
    *,
    log: Path | None = None,
    plant: str = "mujoco",
    seed: int = 0,
    **options: float,
) -> Excitation:
    """Write the drive and, if requested, its log on a plant; print the expected information.

    The options are those of `excite_model`.

    Raises ConfigError if a file cannot be written, or if the robot leaves the room; no log is written then.
    """
    console = output_console()
    with ExitStack() as stack:
        write_log = stack.enter_context(run_log(log))
        with ProgressBar("searching for the drive", lines=True) as bar:
            excitation = excite_model(config, room, seed=seed, on_drive=bar.show, **options)
            drive = excitation.on(plant, seed, out)
            if log is not None:
                build_plant(drive)
            excitation.write(out)
            if log is not None:
                bar.start_stage("driving", 1)
                run = simulate_case(drive, out, bar.show, keep_plans=includes_plans(log))
                check_drive(run, room)
                write_log(run, drive)
    console.print(excitation.table().rich())
    for line in excitation.lines(out):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return excitation


def in_room(config: str, room: Room) -> Case:
    """Build the case of a configuration with a room as fence; raise ConfigError if the configuration does not exist."""
    case = case_of(config)
    fence = {"enabled": True, "length": room.length, "width": room.width, "frame": "start", "x": 0.0, "y": 0.0}
    changes = tuple((f"fence.{key}", value) for key, value in (fence | {"heading": 0.0}).items())
    return replace(case, overrides=changes)


def simulate_case(
    case: Case, trajectory: Path, on_tick: Callable[[int, int], None] | None = None, *, keep_plans: bool = False
) -> Run:
    """Simulate a case along a trajectory file; raise ConfigError if the file or the plant is invalid."""
    limits = controller_config(case.model, case.config, case.overrides)
    parts = make_controller(case), build_plant(case), load_trajectory(trajectory, limits)
    return simulate(*parts, keep_plans=keep_plans, on_tick=on_tick)


def check_drive(run: Run, room: Room) -> None:
    """Raise ConfigError if a run ended early, the robot left the room, or the controller stopped."""
    if run.ended:
        raise ConfigError(f"the drive ended early, after {run.time[-1]:.1f} s: {run.ended}")
    half = 0.5 * np.array([room.length, room.width])
    out = np.flatnonzero((np.abs(run.true_pose[:, :2]) > half).any(axis=1))
    if out.size:
        raise ConfigError(
            f"the robot left the room after {run.time[out[0]]:.1f} s; give a larger room, or a lower --speed"
        )
    reason = next((message for mode, message in zip(run.modes, run.messages, strict=True) if mode == "STOPPED"), None)
    if reason is not None:
        raise ConfigError(f"the controller stopped during the drive ({reason}); give a larger room, or a lower --speed")


def case_of(config: str) -> Case:
    """Build the case of a configuration file or of a shipped model; raise ConfigError if neither exists."""
    if is_shipped(config):
        load_config(config)
        return Case(model=config)
    return Case(model=load_config(config).model, config=config)


def _controller_model(config: ControllerConfig) -> VelocityModel:
    extra = config.extra_dead_time
    return load_linear_model(config.model).with_extra_dead_time([extra.v, extra.omega])


def _limits(config: ControllerConfig, speed: float, yaw_rate: float) -> TrajectoryLimits:
    """Compute the limits of the reference; tracking needs the remaining command limits, as for scaled paths."""
    settings, limits = load_settings(), config.limits
    for name, requested, unit in (("v", speed, "m/s"), ("omega", yaw_rate, "rad/s")):
        maximum = settings.reach_share * getattr(limits, name)
        if not (np.isfinite(requested) and 0 < requested <= maximum):
            option = "--speed" if name == "v" else "--yaw-rate"
            limit = f"limits.{name} = {getattr(limits, name):g} {unit}"
            raise ConfigError(
                f"{option} {requested:g}: with {limit}, give more than 0 and at most {maximum:g} {unit}; tracking "
                "needs the rest"
            )
    slew = model_excitation_settings().slew_share
    return TrajectoryLimits(speed, yaw_rate, slew * limits.v_slew, slew * limits.omega_slew)
