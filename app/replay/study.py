"""`diffdrive-mpc replay`: a recorded drive through a controller, as a study."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from diffdrive_mpc.app.replay.open_loop import DeadTimeWatch, Replayed, replay
from diffdrive_mpc.app.replay.own_log import NAME, read_commands, write_replay
from diffdrive_mpc.app.replay.page import command_charts, draw_path, replay_page, trust_charts
from diffdrive_mpc.app.replay.reading import PoseSource, from_mid_drive, read_recording, up_to
from diffdrive_mpc.app.replay.recording import RecordedTick, Recording
from diffdrive_mpc.app.replay.signals import DRIVEN, driven_paths
from diffdrive_mpc.app.replay.statistics import Difference, SensorRow, difference, sensor_rows
from diffdrive_mpc.app.replay.tables import (
    command_table,
    message_table,
    sensor_table,
    share_table,
    time_table,
    verdict_table,
)
from diffdrive_mpc.app.replay.verdicts import Diagnosis, Evidence, verdicts
from diffdrive_mpc.bench.case import Overrides
from diffdrive_mpc.bench.controllers import chosen_model, controller_config
from diffdrive_mpc.bench.progress import ProgressBar, output_console
from diffdrive_mpc.bench.study import Report, Study, carry_out
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.logs.record import BoolArray
from diffdrive_mpc.models.whole_file import check_not_read
from diffdrive_mpc.mpc import ControllerConfig, load_config, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.typed_settings import single_settings
from diffdrive_mpc.mpc.step_result import LearnedDeadTime, StepResult
from diffdrive_mpc.mpc.trajectories.moved import starting_at

RECORDED, REPLAYED = "recorded", "replayed"


@dataclass(frozen=True)
class ReplayRequest:
    """What was asked for on the command line; see `diffdrive-mpc replay --help`."""

    log: Path
    config: Path | None = None
    model: str | None = None
    settings: Sequence[str] = ()
    trajectory: str | None = None
    start_at_robot: bool = False
    against: str | None = None
    beside: Path | None = None
    mapping: str | None = None
    pose: PoseSource = "log"
    begin: float | None = None
    end: float | None = None
    sample_time: float | None = None
    trusted: Sequence[Path] = ()


@dataclass(frozen=True)
class ReplayPlan:
    """What is to be replayed.

    Attributes
    ----------
    recording
        The drive.
    config
        Of the controller.
    as_recorded
        Whether that is the recorded one.
    references
        What it tracks from each start on.
    reference_words
        Where they come from.
    other
        The second configuration.
    beside
        (n, 2) commands of an earlier replay.
    counted
        (n,) ticks that count.
    """

    recording: Recording
    config: ControllerConfig
    as_recorded: bool
    references: tuple[Reference, ...]
    reference_words: str
    other: ControllerConfig | None
    beside: FloatArray | None
    counted: BoolArray


@dataclass(frozen=True)
class ReplayResult:
    """What a replay gave.

    Attributes
    ----------
    plan
        What was replayed.
    replayed, against
        With the configuration, and with the second one.
    pairs
        Differences of commands by who is compared.
    sensors, dead_time, said
        What the log tells.
    """

    plan: ReplayPlan
    replayed: Replayed
    against: Replayed | None
    pairs: Mapping[tuple[str, str], Difference]
    sensors: tuple[SensorRow, ...]
    dead_time: LearnedDeadTime | None
    said: tuple[Diagnosis, ...]

    @property
    def other(self) -> FloatArray | None:
        """(n, 2) the commands that stand beside those of the replay."""
        return self.plan.beside if self.against is None else self.against.command


class ReplayStudy(Study[ReplayPlan, ReplayResult]):
    """Measurements of a log through a controller, open loop.

    Parameters
    ----------
    request
        What was asked for.
    scratch
        Folder for what has to lie in files while it runs.
    """

    name: ClassVar[str] = "replay"
    title: ClassVar[str] = "A recorded drive, replayed"

    def __init__(self, request: ReplayRequest, scratch: Path) -> None:
        self._request, self._scratch = request, scratch

    def plan(self) -> ReplayPlan:
        """Read the log and say what to ask of it; raises ConfigError or ValueError if something cannot be used."""
        request = self._request
        given = self._given_config()
        sample_time = (given or load_config("ssm")).sample_time
        trusted = request.trusted if given is None else None
        recording = read_recording(
            request.log, request.mapping, sample_time, self._scratch, request.pose, trusted, given
        )
        recording = up_to(recording, request.end)
        config = given or recording.config
        if config is None:
            raise ConfigError(
                f"{request.log}: the log does not hold the configuration of its controller; give --config or --model"
            )
        if given is None:
            config = replace_values(config, dict(self._overrides))
        _check_sample_time(recording, config)
        recording = from_mid_drive(recording, (config.limits.v_slew, config.limits.omega_slew), config.sample_time)
        references, words = self._references(recording, config)
        time = recording.time
        counted = (time >= (-np.inf if request.begin is None else request.begin)) & np.isfinite(time)
        if not counted.any():
            raise ConfigError(f"--from {request.begin:g}: the log ends at {time[-1]:.2f} s; give an earlier time")
        beside = None if request.beside is None else read_commands(request.beside, time)
        other = None if request.against is None else load_config(request.against)
        if other is not None:
            _check_sample_time(recording, other)
        return ReplayPlan(recording, config, given is None, references, words, other, beside, counted)

    def _given_config(self) -> ControllerConfig | None:
        """The configuration that was named; None where the log's own counts."""
        request = self._request
        if request.config is None and request.model is None:
            return None
        file = None if request.config is None else str(request.config)
        return controller_config(chosen_model(request.model, request.config), file, self._overrides)

    @property
    def _overrides(self) -> Overrides:
        """Values by dotted key that were given in place of those of the configuration."""
        request = self._request
        overrides = () if request.sample_time is None else (("sample_time", request.sample_time),)
        return (*single_settings(request.settings), *overrides)

    def _references(self, recording: Recording, config: ControllerConfig) -> tuple[tuple[Reference, ...], str]:
        """What is tracked from each start on, and where it comes from."""
        request = self._request
        starts = [tick.start for tick in recording.ticks if tick.start is not None]
        if request.trajectory is not None:
            reference: Reference = load_trajectory(request.trajectory, config)
            if request.start_at_robot:
                reference = starting_at(reference, _first_pose(recording))
            return (reference,) * len(starts), f"The reference is the trajectory '{request.trajectory}'."
        if len(recording.references) == len(starts):
            return recording.references, "The reference is the one in the log."
        return driven_paths(recording), DRIVEN

    def run(self, plan: ReplayPlan, jobs: int, bar: ProgressBar) -> ReplayResult:
        """Ask the controller at every tick, and the second one."""
        del jobs
        watch = DeadTimeWatch(plan.config)

        def on_step(tick: RecordedTick, step: StepResult) -> None:
            watch.take(tick, step)
            bar.advance()

        count = len(plan.recording.ticks)
        bar.begin("replaying", count)
        replayed = replay(plan.recording, plan.config, plan.references, as_recorded=plan.as_recorded, on_step=on_step)
        against = None
        if plan.other is not None:
            bar.begin("replaying against", count)
            against = replay(
                plan.recording,
                plan.other,
                plan.references,
                as_recorded=False,
                on_step=lambda _tick, _step: bar.advance(),
            )
        sensors = sensor_rows(plan.recording, replayed, plan.counted)
        evidence = Evidence(plan.recording, replayed, plan.counted, sensors, watch.found)
        pairs = self._pairs(plan, replayed, against)
        return ReplayResult(plan, replayed, against, pairs, sensors, watch.found, verdicts(evidence))

    def _pairs(
        self, plan: ReplayPlan, replayed: Replayed, against: Replayed | None
    ) -> dict[tuple[str, str], Difference]:
        commands = {RECORDED: plan.recording.command, REPLAYED: replayed.command}
        if against is not None:
            commands[str(self._request.against)] = against.command
        if plan.beside is not None:
            commands[str(self._request.beside)] = plan.beside
        names = list(commands)
        time, counted = plan.recording.time, plan.counted
        return {
            (name, other): difference(time, commands[name], commands[other], counted)
            for i, name in enumerate(names[:2])
            for other in names[i + 1 :]
        }

    def report(self, results: ReplayResult, seconds: float) -> Report:
        """What there is to show."""
        del seconds
        plan, replayed = results.plan, results.replayed
        recording, counted = plan.recording, plan.counted
        time = recording.time[counted]
        settings = plan.config
        replays = {REPLAYED: replayed} | (
            {} if results.against is None else {str(self._request.against): results.against}
        )
        modes = {RECORDED: [tick.mode for tick in recording.ticks]}
        paths = {RECORDED: [tick.solver_path for tick in recording.ticks]}
        tables = [
            verdict_table(results.said),
            command_table(results.pairs),
            share_table("Modes", modes | {who: list(one.modes) for who, one in replays.items()}, counted),
            share_table(
                "Solver paths", paths | {who: list(one.solver_methods) for who, one in replays.items()}, counted
            ),
            sensor_table(results.sensors),
            time_table(replays, counted),
            message_table(recording, replayed, counted),
        ]
        facts = [
            f"{recording.name}: {recording.source}, {len(time)} ticks from {time[0]:.2f} to {time[-1]:.2f} s; model "
            f"{Path(settings.model).name}, {settings.horizon} steps of {settings.sample_time:g} s.",
            agreement(results, by_controller=recording.by_controller),
            plan.reference_words,
            *recording.approximated,
            *recording.findings,
        ]
        return Report(
            counted=f"{len(time)} ticks",
            meta={"log": str(self._request.log), "config": settings},
            content=content(results),
            facts=facts,
            tables=[table for table in tables if table.rows],
            figures={
                "commands.png": command_charts(recording, replayed, results.other, counted),
                "path.png": partial(draw_path, recording, replayed, plan.references, counted),
                "trust.png": trust_charts(recording, replayed, counted),
            },
            shown=replay_page(
                recording, replays, plan.references, counted, results.pairs[RECORDED, REPLAYED], results.said
            ),
        )


def agreement(results: ReplayResult, *, by_controller: bool) -> str:
    """Whether the replay commands what was recorded, in a sentence."""
    pair = results.pairs[RECORDED, REPLAYED]
    if not pair.compared:
        return "The log holds no commands to compare with."
    largest = f"{pair.largest[0]:.3g} m/s and {pair.largest[1]:.3g} rad/s"
    if pair.same:
        return f"Replayed and recorded commands are the same at every tick; the largest differences are {largest}."
    if not by_controller:
        return (
            f"Another one drove, so commands differ: by {pair.rms[0]:.3g} m/s and {pair.rms[1]:.3g} rad/s RMS, at "
            f"most by {largest}. That is no error; it says how differently this controller would have driven."
        )
    return (
        f"Replayed and recorded commands differ at {pair.differing} of {pair.compared} ticks, first at "
        f"{pair.first:.2f} s, by {pair.rms[0]:.3g} m/s and {pair.rms[1]:.3g} rad/s RMS, at most by {largest}. With "
        "the configuration, the path and the release that drove they are the same but for what is said below."
    )


def content(results: ReplayResult) -> dict[str, object]:
    """What replay.json holds beside `meta`."""
    return {
        "commands": [{"one": one, "other": other, **vars(pair)} for (one, other), pair in results.pairs.items()],
        "sensors": [
            vars(row) | {"innovations": {name: {"count": count, "mean": mean} for name, count, mean in row.innovations}}
            for row in results.sensors
        ],
        "dead_time": results.dead_time,
        "verdicts": [vars(one) for one in results.said],
        "approximated": list(results.plan.recording.approximated),
        "findings": list(results.plan.recording.findings),
    }


def _check_sample_time(recording: Recording, config: ControllerConfig) -> None:
    """Refuse a configuration whose ticks are of another length than those of the log."""
    steps = np.diff(recording.time)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else config.sample_time
    if not 0.5 * config.sample_time < usual < 2.0 * config.sample_time:
        raise ConfigError(
            f"{recording.name}: its ticks come every {1e3 * usual:.3g} ms, sample_time is "
            f"{1e3 * config.sample_time:.3g} ms; give the configuration that drove, or --sample-time {usual:.4g}"
        )


def _first_pose(recording: Recording) -> FloatArray:
    poses = (tick.measurement.pose for tick in recording.ticks)
    first = next((pose for pose in poses if pose is not None), None)
    if first is None:
        raise ConfigError(f"{recording.name}: no poses, so --start-at-robot has nowhere to start")
    return np.asarray(first.value, dtype=float)


# What `diffdrive-mpc replay` does: the study, what it found in words, and replay.csv.


def replay_into(request: ReplayRequest, out: Path) -> None:
    """Replay a log into the folder `out`, and say what was found; raises as `carry_out` does."""
    check_not_read(out / NAME, f"--out {out / NAME}")
    with tempfile.TemporaryDirectory() as folder:
        results = carry_out(ReplayStudy(request, Path(folder)), out)
        recording = results.plan.recording
        write_replay(recording, results.replayed, results.other, out / NAME)
    console = output_console()
    lines = [agreement(results, by_controller=recording.by_controller), results.plan.reference_words]
    lines += [*recording.approximated, *recording.findings]
    for line in lines:
        console.print(line, markup=False, highlight=False)
