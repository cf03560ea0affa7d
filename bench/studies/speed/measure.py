"""Measure every subject on one problem: closed loops in turn, tick by tick; then replays in turn, block by block."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.peers.command_limits import slew_step
from diffdrive_mpc.bench.studies.speed.closed_loop_cost import closed_loop_cost
from diffdrive_mpc.bench.studies.speed.drive import Drive
from diffdrive_mpc.bench.studies.speed.process.environment import PeerEnvironment
from diffdrive_mpc.bench.studies.speed.process.subject import Subject, SubjectError, TimedStep
from diffdrive_mpc.bench.studies.speed.results import Missing, SpeedRecord, time_statistics
from diffdrive_mpc.bench.studies.speed.settings import SpeedSettings, SubjectSettings
from diffdrive_mpc.bench.studies.speed.stage import StageProblem, stage_problem
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.schema import ControllerConfig

_AT_LIMIT = 1e-5
"""A command this close to a limit stands at it [m/s, rad/s]."""


@dataclass(frozen=True)
class SpeedProblem:
    """One model and horizon."""

    name: str
    horizon: int
    config: ControllerConfig
    model: VelocityModel
    stages: StageProblem


@dataclass
class _Running:
    """A subject in the middle of it."""

    name: str
    problem: SpeedProblem
    drive: Drive
    built: dict[str, float]
    replays: list[list[TimedStep]]
    lost: str = ""


def load_problem(settings: SpeedSettings, model: str, horizon: int) -> SpeedProblem:
    """The problem for a model by name; raises ConfigError if its configuration cannot be used."""
    config = controller_config(model, None, (*settings.config.items(), ("horizon", horizon)))
    loaded = Controller(config).model
    assert isinstance(loaded, VelocityModel)
    return SpeedProblem(model, horizon, config, loaded, stage_problem(config, loaded.discretise(config.sample_time)))


def measure(
    settings: SpeedSettings,
    problem: SpeedProblem,
    environment: PeerEnvironment | SubjectError | None,
    folder: Path,
    core: int | None,
    on_tick: Callable[[], None],
) -> tuple[list[SpeedRecord], list[Missing]]:
    """Measure all subjects of `settings` on `problem`.

    Parameters
    ----------
    settings, problem
        What to run.
    environment
        Of the peers that need their own; or why there is none.
    folder
        For what the subjects generate.
    core
        The core that everybody runs on; None where a process cannot be bound to one.
    on_tick
        Called after each tick of the closed loops.
    """
    missing: list[Missing] = []
    running: list[_Running] = []
    with ExitStack() as stack:
        for name, chosen in settings.subjects.items():
            try:
                subject, built = _build(stack, settings, problem, chosen, environment, folder / _plain(name), core)
            except SubjectError as error:
                missing.append(Missing(name, problem.name, problem.horizon, str(error)))
                continue
            drive = Drive(problem.config, problem.model, settings, subject, chosen.kind == "ours")
            running.append(_Running(name, problem, drive, built, []))
        for _ in range(settings.ticks):
            for one in running:
                _guarded(one, one.drive.step)
            on_tick()
        for _ in range(settings.repetitions):
            replayed = [one for one in running if not one.lost and _typical(one) < settings.replayed_below]
            turns = [(one, _replay(one, settings.block)) for one in replayed]
            for _ in range(0, settings.ticks, settings.block):
                for one, turn in turns:
                    _guarded(one, lambda turn=turn: next(turn))  # type: ignore[misc]
        converged, _ = _build(stack, settings, problem, settings.converged, None, folder / "converged", core)
        measured = []
        for one in running:
            if not one.lost:
                measured.append(_measured(one, _gaps(one, converged, settings.gap_every)))
            else:
                missing.append(Missing(one.name, problem.name, problem.horizon, one.lost))
    return measured, missing


def _build(
    stack: ExitStack,
    settings: SpeedSettings,
    problem: SpeedProblem,
    chosen: SubjectSettings,
    environment: PeerEnvironment | SubjectError | None,
    folder: Path,
    core: int | None,
) -> tuple[Subject, dict[str, float]]:
    if chosen.kind == "acados" and not shutil.which("gcc"):
        raise SubjectError("no C compiler: it needs gcc")
    if chosen.foreign:
        if not isinstance(environment, PeerEnvironment):
            raise environment or SubjectError("it needs the peers' environment")
        subject = stack.enter_context(Subject(chosen.kind, folder, environment.python, environment.variables))
    else:
        subject = stack.enter_context(Subject(chosen.kind, folder))
    if chosen.kind == "ours":
        config = replace_values(problem.config, chosen.settings)
        return subject, subject.build(config, {"trajectory": settings.trajectory}, core)
    return subject, subject.build(asdict(problem.stages), chosen.settings, core)


def _guarded(one: _Running, act: Callable[[], object]) -> None:
    """Let a subject act; one that fails drops out with its reason, the others go on."""
    if one.lost:
        return
    try:
        act()
    except SubjectError as error:
        one.lost = str(error)


def _typical(one: _Running) -> float:
    return float(np.median([step.whole for step in one.drive.steps]))


def _replay(one: _Running, block: int) -> Iterator[None]:
    """The whole drive again, a block at a time."""
    ticks = one.drive.ticks
    one.drive.subject.reset(ticks[0])
    one.replays.append([])
    for first in range(0, len(ticks), block):
        one.replays[-1] += one.drive.subject.run(ticks[first : first + block])
        yield


def _gaps(one: _Running, converged: Subject, every: int) -> FloatArray:
    """(n, 2) |command - converged command| at every so many ticks."""
    gaps: list[FloatArray] = []
    for k in range(0, len(one.drive.ticks), every):
        data = one.drive.peer_data[k]
        converged.reset(data)
        (step,) = converged.run([data])
        if step.solved:
            gaps.append(np.abs(np.subtract(one.drive.steps[k].command, step.command)))
    return np.array(gaps or [np.full(2, np.nan)])


def _measured(one: _Running, gaps: FloatArray) -> SpeedRecord:
    drive, problem = one.drive, one.problem
    runs = one.replays or [drive.steps]
    whole = np.array([[step.whole for step in run] for run in runs])
    inside = np.array([[step.inside for step in run] for run in runs])
    iterations = [step.iterations for step in drive.steps]
    command = np.array(drive.command)
    cost = closed_loop_cost(
        np.array(drive.pose), np.array(drive.twist), command, drive.reference, problem.config, problem.model
    )
    memory = drive.subject.memory()
    return SpeedRecord(
        solver=one.name,
        model=problem.name,
        horizon=problem.horizon,
        iterations_p50=float(np.median(iterations)),
        iterations_max=max(iterations),
        closed_loop_cost=cost,
        gap_v_p50=float(np.median(gaps[:, 0])),
        gap_v_max=float(gaps[:, 0].max()),
        gap_omega_p50=float(np.median(gaps[:, 1])),
        gap_omega_max=float(gaps[:, 1].max()),
        active_share=_active_share(command, problem.config),
        unsolved=sum(not step.solved for step in drive.steps),
        samples=whole.size,
        ticks=len(command),
        build_s=one.built["build_s"],
        memory_bytes=memory,
        memory_growth_bytes=memory - one.built["before_bytes"],
        whole=whole,
        **time_statistics(whole, inside),
    )


def _active_share(command: FloatArray, config: ControllerConfig) -> float:
    increment = np.diff(command, axis=0, prepend=np.zeros((1, 2)))
    box = np.array([config.limits.v, config.limits.omega])
    slew = slew_step(config.limits, config.sample_time)
    at_limit = (np.abs(command) > box - _AT_LIMIT) | (np.abs(increment) > slew - _AT_LIMIT)
    return float(at_limit.any(axis=1).mean())


def _plain(name: str) -> str:
    return name.replace("/", "-")
