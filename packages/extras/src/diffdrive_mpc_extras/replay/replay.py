"""Replay of a recorded drive: a new controller gets the recorded measurements and previous commands."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.bench.controllers import controller_config, select_model
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.typed_settings import parse_single_settings
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc_extras.replay.node_log import LoggedConfigs
from diffdrive_mpc_extras.replay.own_log import read_recording
from diffdrive_mpc_extras.replay.recording import Recording

_ROUNDING = 1e-9
"""Maximum difference of two commands that counts as rounding [m/s, rad/s]."""


@dataclass(frozen=True)
class ReplayRequest:
    """Arguments of `diffdrive-mpc log replay`."""

    log: Path
    config: Path | None = None
    model: str | None = None
    settings: Sequence[str] = ()
    trajectory: str | None = None
    trusted: Sequence[Path] = ()


class ReplayResult(NamedTuple):
    """Results of a replay at the n ticks of a recording."""

    command: FloatArray
    """Commands (n, 2) v [m/s], omega [rad/s]."""
    modes: tuple[str, ...]
    messages: tuple[str, ...]


class Difference(NamedTuple):
    """Differences of two columns of commands."""

    rms: float
    maximum: float
    time: float
    """Time of the maximum difference [s]."""
    ticks: int
    """Number of ticks that differ."""
    first: float
    """Time of the first difference [s]; NaN if there is none."""


def replay(
    recording: Recording,
    config: ControllerConfig,
    references: tuple[Reference, ...],
    *,
    as_recorded: bool,
    on_step: Callable[[], None] = lambda: None,
) -> ReplayResult:
    """Step a new controller at every tick of `recording`.

    Parameters
    ----------
    config
        Configuration of the controller.
    references
        Reference of each start.
    as_recorded
        True to repeat the changes of weights and limits of the drive.
    on_step
        Called after each tick.

    Raises ConfigError or ValueError if the configuration cannot be used, or a reference exceeds its limits.
    """
    controller = Controller(config)
    steps: list[StepResult] = []
    next_references = iter(references)
    for index, tick in enumerate(recording.ticks):
        if tick.start is not None:
            if tick.start.is_reset and index:
                controller.reset()
            start = controller.switch_reference if tick.start.goes_on else controller.start
            start(next(next_references), tick.start.t0)
        if tick.config is not None and as_recorded:
            limits = {name: value for name, value in tick.config.limits.model_dump().items() if value is not None}
            controller.update(weights=tick.config.weights.model_dump(), limits=limits)
        steps.append(controller.step(tick.time, tick.measurement, tick.hold, most_iterations=tick.stopped_after))
        if np.isfinite(tick.command).all():
            controller.set_applied_commands([tick.command])
        on_step()
    modes, messages = tuple(str(step.mode) for step in steps), tuple(step.message for step in steps)
    return ReplayResult(np.array([step.command for step in steps]), modes, messages)


def difference(time: FloatArray, recorded: FloatArray, replayed: FloatArray) -> Difference:
    """Compare columns of commands (n,) at `time` (n,) [s], as far as the recorded commands are known."""
    is_known = np.isfinite(recorded)
    if not is_known.any():
        return Difference(np.nan, np.nan, np.nan, 0, np.nan)
    time, errors = time[is_known], np.abs(recorded - replayed)[is_known]
    differs = errors > _ROUNDING
    first = float(time[np.argmax(differs)]) if differs.any() else np.nan
    index = int(np.argmax(errors))
    rms = float(np.sqrt(np.mean(errors**2)))
    return Difference(rms, float(errors[index]), float(time[index]), int(differs.sum()), first)


def replay_log(request: ReplayRequest) -> None:
    """Replay a log and print the differences of its commands; raises ConfigError or ValueError for invalid input."""
    with tempfile.TemporaryDirectory() as scratch:
        requested = _requested_config(request)
        configs = LoggedConfigs(request.log, Path(scratch), request.trusted if requested is None else None)
        recording = read_recording(request.log, configs)
        config = requested or recording.config
        if config is None:
            raise ConfigError(f"{request.log}: the log does not contain a configuration; use --config or --model")
        if requested is None:
            config = replace_values(config, dict(parse_single_settings(request.settings)))
        _check_sample_time(recording, config)
        references = _references(recording, config, request.trajectory)
        with ProgressBar("replaying") as bar:
            bar.start_stage("replaying", len(recording.ticks))
            result = replay(recording, config, references, as_recorded=requested is None, on_step=bar.advance)
    _print_differences(recording, result)


def _requested_config(request: ReplayRequest) -> ControllerConfig | None:
    """Return the configuration of the command line; None to use the configuration in the log."""
    if request.config is None and request.model is None:
        return None
    file = None if request.config is None else str(request.config)
    return controller_config(select_model(request.model, request.config), file, parse_single_settings(request.settings))


def _check_sample_time(recording: Recording, config: ControllerConfig) -> None:
    steps = np.diff(recording.time)
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else config.sample_time
    if not 0.5 * config.sample_time < period < 2.0 * config.sample_time:
        raise ConfigError(
            f"{recording.name}: the period of its ticks is {1e3 * period:.3g} ms, sample_time is "
            f"{1e3 * config.sample_time:.3g} ms; use the configuration of the drive"
        )


def _references(recording: Recording, config: ControllerConfig, trajectory: str | None) -> tuple[Reference, ...]:
    if trajectory is not None:
        return (load_trajectory(trajectory, config),) * len(recording.starts)
    if len(recording.references) < len(recording.starts):
        raise ConfigError(f"{recording.name}: the log does not contain its reference; use --trajectory")
    return recording.references


def _print_differences(recording: Recording, result: ReplayResult) -> None:
    console = output_console()
    rows = []
    different_ticks = 0
    for column, name in enumerate(("v [m/s]", "omega [rad/s]")):
        pair = difference(recording.time, recording.command[:, column], result.command[:, column])
        different_ticks += pair.ticks
        sizes = (f"{pair.rms:.3g}", f"{pair.maximum:.3g}", number(pair.time, 2))
        rows.append((name, *sizes, str(pair.ticks), number(pair.first, 2)))
    modes = sum(tick.mode != mode for tick, mode in zip(recording.ticks, result.modes, strict=True) if tick.mode)
    verdict = f"differ; modes differ at {modes} ticks" if different_ticks or modes else "are equal at every tick"
    time = f"{len(recording.ticks)} ticks from {recording.time[0]:.2f} to {recording.time[-1]:.2f} s"
    for line in (f"{recording.name}, {time}: recorded and replayed commands {verdict}.", *recording.notes):
        console.print(line, markup=False, highlight=False)
    columns = ("command", "RMS", "maximum", "at [s]", "ticks that differ", "first [s]")
    note = f"Differences of recorded and replayed commands; differences up to {_ROUNDING:g} m/s or rad/s are ignored."
    console.print(Table("Differences", columns, tuple(rows), note=note).rich())
