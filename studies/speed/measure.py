"""Measure every subject at one horizon: closed loops in turn, tick by tick; then replays in turn, block by block."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.bench.peers.tracking_peer import slew_step
from diffdrive_mpc.bench.turns import TurnTimes, take_turns
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from studies.speed.closed_loop_cost import closed_loop_cost
from studies.speed.drive import ClosedLoop
from studies.speed.process.environment import PeerEnvironment
from studies.speed.process.subject import Subject, SubjectError, TimedStep
from studies.speed.results import Missing, SpeedRecord, time_statistics
from studies.speed.settings import SpeedSettings, SubjectSettings
from studies.speed.stage import StageProblem, stage_problem

T = TypeVar("T")
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


@dataclass(eq=False)
class _Running:
    """A subject in the middle of it; satisfies `bench.turns.Replay`."""

    name: str
    problem: SpeedProblem
    drive: ClosedLoop
    built: dict[str, float]
    times: TurnTimes | None = None
    lost: str = ""

    @property
    def ticks(self) -> int:
        """Of the drive."""
        return len(self.drive.ticks)

    def restart(self) -> None:
        """Begin the drive anew."""
        self.guarded(lambda: self.drive.subject.reset(self.drive.ticks[0]))

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort] | None:
        """Times (ticks, 2) of whole steps and inside the solver [s]; None where the subject has failed."""
        result = self.guarded(lambda: self.drive.subject.run(self.drive.ticks[first:last]))
        return None if result is None else (_times(result[0]), result[1])

    def guarded(self, act: Callable[[], T]) -> T | None:
        """Let the subject act; one that fails drops out with its reason, the others go on."""
        try:
            return None if self.lost else act()
        except SubjectError as error:
            self.lost = str(error)
            return None


def _times(steps: Sequence[TimedStep]) -> FloatArray:
    return np.array([(step.whole, step.inside) for step in steps])


def load_problem(settings: SpeedSettings, model: str, horizon: int) -> SpeedProblem:
    """The problem for a model by name; raises ConfigError if its configuration cannot be used."""
    config = controller_config(model, None, (*settings.config.items(), ("horizon", horizon)))
    loaded = Controller(config).model
    assert isinstance(loaded, VelocityModel)
    return SpeedProblem(model, horizon, config, loaded, stage_problem(config, loaded.discretise(config.sample_time)))


def measure(
    settings: SpeedSettings,
    problems: Sequence[SpeedProblem],
    environment: PeerEnvironment | SubjectError | None,
    folder: Path,
    core: int | None,
    on_tick: Callable[[], None],
) -> tuple[list[SpeedRecord], list[Missing]]:
    """Measure all subjects of `settings` on all of `problems`, which are compared with each other.

    Parameters
    ----------
    settings, problems
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
        for problem, (name, chosen) in itertools.product(problems, settings.subjects.items()):
            place = folder / problem.name / _plain(name)
            try:
                subject, built = _build(stack, settings, problem, chosen, environment, place, core)
            except SubjectError as error:
                missing.append(Missing(name, problem.name, problem.horizon, str(error)))
                continue
            drive = ClosedLoop(problem.config, problem.model, settings, subject, chosen.kind == "ours")
            running.append(_Running(name, problem, drive, built))
        for _ in range(settings.ticks):
            for one in running:
                one.guarded(one.drive.step)
            on_tick()
        _replay([one for one in running if not one.lost], settings)
        converged = {
            problem.name: _build(
                stack, settings, problem, settings.converged, None, folder / problem.name / "converged", core
            )[0]
            for problem in problems
        }
        measured = []
        for one in running:
            if not one.lost:
                measured.append(_measured(one, _gaps(one, converged[one.problem.name], settings.gap_every)))
            else:
                missing.append(Missing(one.name, one.problem.name, one.problem.horizon, one.lost))
    return measured, missing


def _replay(running: Sequence[_Running], settings: SpeedSettings) -> None:
    """Time all of them; those too slow to be replayed have the times of their closed loop."""
    quick = [one for one in running if _typical(one) < settings.replayed_below]
    (costs,), best = take_turns([quick], repetitions=settings.repetitions, block=settings.block)
    for one, times in zip(quick, costs, strict=True):
        one.times = times
    best = min([best, *(effort.pace for one in running for effort in one.drive.efforts)])
    for one in running:
        clean = np.array([[effort.undisturbed(best) for effort in one.drive.efforts]])
        one.times = one.times or TurnTimes(_times(one.drive.steps)[None], clean)


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


def _typical(subject: _Running) -> float:
    return float(np.median([step.whole for step in subject.drive.steps]))


def _gaps(subject: _Running, converged: Subject, every: int) -> FloatArray:
    """(n, 2) |command - converged command| at every so many ticks."""
    gaps: list[FloatArray] = []
    for k in range(0, len(subject.drive.ticks), every):
        data = subject.drive.peer_data[k]
        converged.reset(data)
        (step,), _ = converged.run([data])
        if step.solved:
            gaps.append(np.abs(np.subtract(subject.drive.steps[k].command, step.command)))
    return np.array(gaps or [np.full(2, np.nan)])


def _measured(subject: _Running, gaps: FloatArray) -> SpeedRecord:
    drive, problem = subject.drive, subject.problem
    assert subject.times is not None
    whole, inside = np.moveaxis(subject.times.kept, -1, 0)
    iterations = [step.iterations for step in drive.steps]
    command = np.array(drive.command)
    cost = closed_loop_cost(
        np.array(drive.pose), np.array(drive.twist), command, drive.reference, problem.config, problem.model
    )
    memory = drive.subject.memory()
    return SpeedRecord(
        solver=subject.name,
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
        samples=int(np.isfinite(whole).sum()),
        clean_share=subject.times.share,
        ticks=len(command),
        build_s=subject.built["build_s"],
        memory_bytes=memory,
        memory_growth_bytes=memory - subject.built["before_bytes"],
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
