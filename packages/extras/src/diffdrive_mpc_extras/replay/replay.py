"""Repeat a recorded drive: a fresh controller gets the measurements and takes the recorded commands as sent."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.bench.controllers import chosen_model, controller_config
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.mpc import Controller, ControllerConfig, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.typed_settings import single_settings
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc_extras.replay.node_log import LoggedConfigs
from diffdrive_mpc_extras.replay.own_log import read_recording
from diffdrive_mpc_extras.replay.recording import Recording

_EQUAL = 1e-9
"""Largest difference of two commands that counts as rounding [m/s, rad/s]."""


@dataclass(frozen=True)
class ReplayRequest:
    """Arguments of `diffdrive-mpc log replay`."""

    log: Path
    config: Path | None = None
    model: str | None = None
    settings: Sequence[str] = ()
    trajectory: str | None = None
    trusted: Sequence[Path] = ()


class Replayed(NamedTuple):
    """Results of a replay at the n ticks of a recording."""

    command: FloatArray
    """(n, 2) v [m/s], omega [rad/s]."""
    modes: tuple[str, ...]
    messages: tuple[str, ...]


class Difference(NamedTuple):
    """Difference of two columns of commands."""

    rms: float
    largest: float
    time: float
    """Time of the largest difference [s]."""
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
) -> Replayed:
    """Step a fresh controller at every tick of `recording`.

    Parameters
    ----------
    config
        Configuration of the controller.
    references
        Reference of each start.
    as_recorded
        True if weights and limits change as they did in the drive.
    on_step
        Called after each tick.

    Raises ConfigError or ValueError if the configuration cannot be used, or a reference exceeds its limits.
    """
    controller = Controller(config)
    steps: list[StepResult] = []
    waiting = iter(references)
    for index, tick in enumerate(recording.ticks):
        if tick.start is not None:
            if tick.start.is_reset and index:
                controller.reset()
            start = controller.switch_reference if tick.start.goes_on else controller.start
            start(next(waiting), tick.start.t0)
        if tick.config is not None and as_recorded:
            limits = {name: value for name, value in tick.config.limits.model_dump().items() if value is not None}
            controller.update(weights=tick.config.weights.model_dump(), limits=limits)
        steps.append(controller.step(tick.time, tick.measurement, tick.hold, most_iterations=tick.stopped_after))
        if np.isfinite(tick.command).all():
            controller.set_applied_commands([tick.command])
        on_step()
    modes, messages = tuple(str(step.mode) for step in steps), tuple(step.message for step in steps)
    return Replayed(np.array([step.command for step in steps]), modes, messages)


def difference(time: FloatArray, recorded: FloatArray, replayed: FloatArray) -> Difference:
    """Compare columns of commands (n,) at `time` (n,) [s] where the recorded one is known."""
    known = np.isfinite(recorded)
    if not known.any():
        return Difference(np.nan, np.nan, np.nan, 0, np.nan)
    time, apart = time[known], np.abs(recorded - replayed)[known]
    differs = apart > _EQUAL
    first = float(time[np.argmax(differs)]) if differs.any() else np.nan
    largest = int(np.argmax(apart))
    rms = float(np.sqrt(np.mean(apart**2)))
    return Difference(rms, float(apart[largest]), float(time[largest]), int(differs.sum()), first)


def replay_log(request: ReplayRequest) -> None:
    """Replay a log and print how its commands differ; raise ConfigError or ValueError if something cannot be used."""
    with tempfile.TemporaryDirectory() as scratch:
        named = _named_config(request)
        configs = LoggedConfigs(request.log, Path(scratch), request.trusted if named is None else None)
        recording = read_recording(request.log, configs)
        config = named or recording.config
        if config is None:
            raise ConfigError(f"{request.log}: the log does not hold a configuration; give --config or --model")
        if named is None:
            config = replace_values(config, dict(single_settings(request.settings)))
        _check_sample_time(recording, config)
        references = _references(recording, config, request.trajectory)
        with ProgressBar("replaying") as bar:
            bar.start_stage("replaying", len(recording.ticks))
            replayed = replay(recording, config, references, as_recorded=named is None, on_step=bar.advance)
    _print(recording, replayed)


def _named_config(request: ReplayRequest) -> ControllerConfig | None:
    """Return the configuration of the command line; None if the one in the log counts."""
    if request.config is None and request.model is None:
        return None
    file = None if request.config is None else str(request.config)
    return controller_config(chosen_model(request.model, request.config), file, single_settings(request.settings))


def _check_sample_time(recording: Recording, config: ControllerConfig) -> None:
    steps = np.diff(recording.time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else config.sample_time
    if not 0.5 * config.sample_time < usual < 2.0 * config.sample_time:
        raise ConfigError(
            f"{recording.name}: its ticks come every {1e3 * usual:.3g} ms, sample_time is "
            f"{1e3 * config.sample_time:.3g} ms; give the configuration of the drive"
        )


def _references(recording: Recording, config: ControllerConfig, trajectory: str | None) -> tuple[Reference, ...]:
    if trajectory is not None:
        return (load_trajectory(trajectory, config),) * len(recording.starts)
    if len(recording.references) < len(recording.starts):
        raise ConfigError(f"{recording.name}: the log does not hold its reference; give --trajectory")
    return recording.references


def _print(recording: Recording, replayed: Replayed) -> None:
    console = output_console()
    rows = []
    differing = 0
    for column, name in enumerate(("v [m/s]", "omega [rad/s]")):
        pair = difference(recording.time, recording.command[:, column], replayed.command[:, column])
        differing += pair.ticks
        sizes = (f"{pair.rms:.3g}", f"{pair.largest:.3g}", number(pair.time, 2))
        rows.append((name, *sizes, str(pair.ticks), number(pair.first, 2)))
    modes = sum(tick.mode != mode for tick, mode in zip(recording.ticks, replayed.modes, strict=True) if tick.mode)
    words = "are equal at every tick" if not differing and not modes else f"differ; modes differ at {modes} ticks"
    time = f"{len(recording.ticks)} ticks from {recording.time[0]:.2f} to {recording.time[-1]:.2f} s"
    for line in (f"{recording.name}, {time}: recorded and replayed commands {words}.", *recording.notes):
        console.print(line, markup=False, highlight=False)
    columns = ("command", "RMS", "largest", "at [s]", "ticks that differ", "first [s]")
    note = f"Differences of recorded and replayed commands; up to {_EQUAL:g} m/s or rad/s they count as equal."
    console.print(Table("Differences", columns, tuple(rows), note=note).rich())
