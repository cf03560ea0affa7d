"""Step times of all subjects at one horizon: closed loops in turns of one tick, then replays in turns of one block."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from diffdrive_mpc.bench.controllers import controller_config
from diffdrive_mpc.bench.counters import Effort
from diffdrive_mpc.bench.peers.tracking_peer import nearest_command, slew_step
from diffdrive_mpc.bench.turns import TurnTimes, take_turns
from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.pose import ahead_and_left, wrap_angle
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.problem.formulas import formula
from diffdrive_mpc.mpc.problem.margin import with_increments
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.sim import make_plant
from studies.speed.process.environment import PeerEnvironment
from studies.speed.process.subject import Subject, SubjectError, TimedStep
from studies.speed.results import Missing, SpeedRecord, time_statistics
from studies.speed.settings import SpeedSettings, SubjectSettings
from studies.speed.stage import StageProblem, stage_data, stage_problem


class PeerInput:
    """Input of peers: estimate, reference and feed-forward of our controller. Its computing time is not measured."""

    def __init__(self, config: ControllerConfig, model: VelocityModel, reference: Reference) -> None:
        self._config, self._reference = config, reference
        self._controller = Controller(config)
        memory = model.discretise(config.sample_time).memory
        self._past = np.zeros((memory, 2))
        self._started = False

    def data(self, t: float, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """Compute the state of the first stage and the parameters of all stages at `t` [s], as in `stage_data`."""
        if not self._started:
            self._controller.start(self._reference, t)
        # The robot received the command of the subject, not the command of this controller.
        sent = (float(self._past[-1, 0]), float(self._past[-1, 1]))
        complete_measurement = replace(measurement, sent=sent) if self._started else measurement
        self._started = True
        self._controller.program.count_from(self._past[-1])
        estimate = self._controller.step(t, complete_measurement).estimate
        if estimate is None:
            raise RuntimeError("the drive starts without a pose, which peers require")
        return stage_data(self._controller.program, estimate, self._past)

    def limit(self, command: FloatArray) -> FloatArray:
        """Limit a subject's `command` (2,) to the range and slew of our controller; store and return the result."""
        sent = nearest_command(command, self._config.limits, self._config.sample_time, self._past[-1])
        self._past = np.concatenate([self._past[1:], sent[None]])
        return sent


@dataclass
class ClosedLoop:
    """Closed loop of a subject and a simulated robot that runs tick by tick.

    Attributes
    ----------
    config, model, settings, subject
        Configuration and velocity model of the problem, settings of the study, and subject.
    is_ours
        True for our controller, False for a peer.
    ticks, peer_data
        Inputs at each tick, for replays: of the subject, and of a peer.
    steps, efforts
        Results and computing efforts of the steps.
    pose, twist, command
        True pose (3,) and twist (2,) before each tick, and sent command (2,).
    """

    config: ControllerConfig
    model: VelocityModel
    settings: SpeedSettings
    subject: Subject
    is_ours: bool
    ticks: list[tuple[Any, ...]] = field(default_factory=list)
    peer_data: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    steps: list[TimedStep] = field(default_factory=list)
    efforts: list[Effort] = field(default_factory=list)
    pose: list[FloatArray] = field(default_factory=list)
    twist: list[FloatArray] = field(default_factory=list)
    command: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Place the robot at the start of the reference."""
        s = self.settings
        self.reference = load_trajectory(s.trajectory)
        self._plant = make_plant(f"model:{self.config.model}", sensors=s.plant_sensors, seed=s.seed)
        self._plant.reset(self.reference.sample([0.0]).pose[0])
        self._input = PeerInput(self.config, self.model, self.reference)

    def step(self) -> None:
        """Run one tick."""
        plant = self._plant
        t, measurement = plant.time, plant.measure()
        peer_data = self._input.data(t, measurement)
        data = (t, measurement) if self.is_ours else peer_data
        if not self.ticks:
            self.subject.reset(data)
        (step,), effort = self.subject.run([data])
        command = np.array(step.command)
        if not np.isfinite(command).all():
            command = np.zeros(2)
        command = self._input.limit(command)
        self.ticks.append(data)
        self.peer_data.append(peer_data)
        self.steps.append(step)
        self.efforts.append(effort)
        self.pose.append(plant.true_pose)
        self.twist.append(plant.true_twist[[0, 2]])
        self.command.append(command)
        plant.advance(command)


def closed_loop_cost(
    pose: FloatArray,
    twist: FloatArray,
    command: FloatArray,
    reference: Reference,
    config: ControllerConfig,
    model: VelocityModel,
) -> float:
    """Compute the stage cost of `mpc.problem` for the true motion, averaged over the ticks.

    The stage cost is half the weighted sum of squares of the pose error (along and across the reference, and in
    heading), of the deviation of the command from its feed-forward, and of the increment of this deviation, plus the
    penalties on violated soft limits. The terminal weight, slip, and the lead of the feed-forward are not included.

    Parameters
    ----------
    pose
        True poses (n, 3) at the ticks: x [m], y [m], theta [rad]; the first tick is at time 0 of the reference.
    twist
        True twists (n, 2) at the ticks: v [m/s], omega [rad/s].
    command
        Commands (n, 2) sent at the ticks: v_ref [m/s], omega_ref [rad/s]; the robot is at rest before the first tick.
    reference
        Reference to track.
    config
        Weights, limits, track and sample time.
    model
        Velocity model; the feed-forward inverts its steady-state gain.

    Returns
    -------
    float
        Cost per tick [-].

    Raises
    ------
    ValueError
        If the shapes do not match, or a value is not finite.
    """
    n = len(command)
    if pose.shape != (n, 3) or twist.shape != (n, 2) or command.shape != (n, 2):
        raise ValueError(
            f"pose {pose.shape}, twist {twist.shape}, command {command.shape}: expected (n, 3), (n, 2), (n, 2)"
        )
    if not all(np.isfinite(values).all() for values in (pose, twist, command)):
        raise ValueError("pose, twist and command must be finite: a failed drive has no cost")
    parameters = FeedForward.from_model(model, config.sample_time)
    sample = reference.sample(config.sample_time * np.arange(n + int(parameters.whole.max()) + 1))
    w = with_increments(config, model.discretise(config.sample_time)).weights
    path_errors = _path_errors(pose, sample.pose[:n])
    feed_forward = _hold_commands(parameters, sample.twist, n)
    deviation = command - feed_forward
    increment = np.diff(deviation, axis=0, prepend=-feed_forward[:1])
    squares = path_errors**2 @ [w.along, w.across, w.heading]
    squares += deviation**2 @ [w.v, w.omega] + increment**2 @ [w.v_increment, w.omega_increment]
    excess = np.maximum(_soft_values(twist, path_errors[:, 1], config) - _soft_limits(config), 0.0)
    penalty = w.soft * excess.sum(axis=1) + w.soft_quadratic * (excess**2).sum(axis=1) / 2
    return float(np.mean(squares / 2 + penalty))


def _hold_commands(parameters: FeedForward, twist: FloatArray, n: int) -> FloatArray:
    """Compute the steady-state commands (n, 2) for the twist of the reference without slip."""
    rows = np.arange(n)[:, None] + parameters.whole
    current, following = twist[rows, [0, 1]], twist[rows + 1, [0, 1]]
    desired = (current + parameters.fraction * (following - current)).T
    return np.asarray(formula("feed_forward").map(n)(desired, Slip().flat, parameters.inverse_gain)).T


def _path_errors(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """Compute the pose errors (n, 3): along the reference, across the reference, and in heading."""
    error = pose - reference
    return np.column_stack([*ahead_and_left(error, reference[:, 2]), wrap_angle(error[:, 2])])


def _soft_values(twist: FloatArray, across: FloatArray, config: ControllerConfig) -> FloatArray:
    """Compute the magnitudes (n, 5) of v, omega, the rim speeds of both sides, and the error across the path."""
    v, omega = twist.T
    rim = 0.5 * config.wheels.track * omega
    return np.asarray(np.abs(np.column_stack([v, omega, v + rim, v - rim, across])))


def _soft_limits(config: ControllerConfig) -> FloatArray:
    limits = config.limits
    return np.array(
        [limits.predicted_v, limits.predicted_omega, limits.wheel_speed, limits.wheel_speed, limits.corridor]
    )


T = TypeVar("T")
_LIMIT_TOLERANCE = 1e-5
"""Distance from a limit below which a command counts as at the limit [m/s, rad/s]."""


@dataclass(frozen=True)
class SpeedProblem:
    """Tracking problem with one model and one horizon."""

    name: str
    horizon: int
    config: ControllerConfig
    model: VelocityModel
    stages: StageProblem


@dataclass(eq=False)
class _RunningSubject:
    """Subject with its process and closed loop; satisfies `bench.turns.Replay`.

    `failure` is the reason if the subject has failed, otherwise empty.
    """

    name: str
    problem: SpeedProblem
    drive: ClosedLoop
    build_report: dict[str, float]
    times: TurnTimes | None = None
    failure: str = ""

    @property
    def ticks(self) -> int:
        """Number of ticks of the drive."""
        return len(self.drive.ticks)

    def restart(self) -> None:
        """Restart the drive."""
        self.call(lambda: self.drive.subject.reset(self.drive.ticks[0]))

    def run(self, first: int, last: int) -> tuple[FloatArray, Effort] | None:
        """Run ticks; return times (ticks, 2) of step and solver [s] and the effort, or None if the subject failed."""
        result = self.call(lambda: self.drive.subject.run(self.drive.ticks[first:last]))
        return None if result is None else (_times(result[0]), result[1])

    def call(self, function: Callable[[], T]) -> T | None:
        """Call a function of the subject; return None if the subject fails or has failed, and store the reason."""
        try:
            return None if self.failure else function()
        except SubjectError as error:
            self.failure = str(error)
            return None


def _times(steps: Sequence[TimedStep]) -> FloatArray:
    return np.array([(step.whole, step.inside) for step in steps])


def load_problem(settings: SpeedSettings, model: str, horizon: int) -> SpeedProblem:
    """Load the problem of a model by its name; raise ConfigError if the configuration is unusable."""
    config = controller_config(model, None, (*settings.config.items(), ("horizon", horizon)))
    linear = Controller(config).model
    assert isinstance(linear, VelocityModel)
    return SpeedProblem(model, horizon, config, linear, stage_problem(config, linear.discretise(config.sample_time)))


def measure(
    settings: SpeedSettings,
    problems: Sequence[SpeedProblem],
    environment: PeerEnvironment | SubjectError | None,
    folder: Path,
    core: int | None,
    on_tick: Callable[[], None],
) -> tuple[list[SpeedRecord], list[Missing]]:
    """Measure the step times of all subjects of `settings` on all `problems`; the subjects and problems alternate.

    Parameters
    ----------
    settings, problems
        Settings and problems of the study.
    environment
        Environment of the peers, None if no peer requires it, or the error if it cannot be created.
    folder
        Folder for files that the subjects generate.
    core
        Processor core for all subjects; None if the operating system cannot bind a process to a core.
    on_tick
        Function that is called after each tick of the closed loops of all subjects.
    """
    missing: list[Missing] = []
    running: list[_RunningSubject] = []
    with ExitStack() as stack:
        for problem, (name, choice) in itertools.product(problems, settings.subjects.items()):
            subject_folder = folder / problem.name / _folder_name(name)
            try:
                subject, build_report = _build(stack, settings, problem, choice, environment, subject_folder, core)
            except SubjectError as error:
                missing.append(Missing(name, problem.name, problem.horizon, str(error)))
                continue
            drive = ClosedLoop(problem.config, problem.model, settings, subject, choice.kind == "ours")
            running.append(_RunningSubject(name, problem, drive, build_report))
        for _ in range(settings.ticks):
            for candidate in running:
                candidate.call(candidate.drive.step)
            on_tick()
        _replay([candidate for candidate in running if not candidate.failure], settings)
        converged = {
            problem.name: _build(
                stack, settings, problem, settings.converged, None, folder / problem.name / "converged", core
            )[0]
            for problem in problems
        }
        records = []
        for candidate in running:
            if not candidate.failure:
                records.append(
                    _record(candidate, _gaps(candidate, converged[candidate.problem.name], settings.gap_every))
                )
            else:
                missing.append(
                    Missing(candidate.name, candidate.problem.name, candidate.problem.horizon, candidate.failure)
                )
    return records, missing


def _replay(running: Sequence[_RunningSubject], settings: SpeedSettings) -> None:
    """Measure step times by replays; subjects that are too slow for replays keep the times of their closed loops."""
    fast = [subject for subject in running if _median_step_time(subject) < settings.replayed_below]
    (costs,), best = take_turns([fast], repetitions=settings.repetitions, block=settings.block)
    for subject, times in zip(fast, costs, strict=True):
        subject.times = times
    best = min([best, *(effort.pace for subject in running for effort in subject.drive.efforts)])
    for subject in running:
        undisturbed = np.array([[effort.is_undisturbed(best) for effort in subject.drive.efforts]])
        subject.times = subject.times or TurnTimes(_times(subject.drive.steps)[None], undisturbed)


def _build(
    stack: ExitStack,
    settings: SpeedSettings,
    problem: SpeedProblem,
    choice: SubjectSettings,
    environment: PeerEnvironment | SubjectError | None,
    folder: Path,
    core: int | None,
) -> tuple[Subject, dict[str, float]]:
    if choice.kind == "acados" and not shutil.which("gcc"):
        raise SubjectError("the C compiler gcc is missing: install gcc")
    if choice.needs_environment:
        if not isinstance(environment, PeerEnvironment):
            raise environment or SubjectError("the peers' environment is missing")
        subject = stack.enter_context(Subject(choice.kind, folder, environment.python, environment.variables))
    else:
        subject = stack.enter_context(Subject(choice.kind, folder))
    if choice.kind == "ours":
        config = replace_values(problem.config, choice.settings)
        return subject, subject.build(config, {"trajectory": settings.trajectory}, core)
    return subject, subject.build(asdict(problem.stages), choice.settings, core)


def _median_step_time(subject: _RunningSubject) -> float:
    return float(np.median([step.whole for step in subject.drive.steps]))


def _gaps(subject: _RunningSubject, converged: Subject, interval: int) -> FloatArray:
    """Compute |command - converged command| (n, 2) [m/s, rad/s] at every `interval`-th tick."""
    gaps: list[FloatArray] = []
    for k in range(0, len(subject.drive.ticks), interval):
        data = subject.drive.peer_data[k]
        converged.reset(data)
        (step,), _ = converged.run([data])
        if step.solved:
            gaps.append(np.abs(np.subtract(subject.drive.steps[k].command, step.command)))
    return np.array(gaps or [np.full(2, np.nan)])


def _record(subject: _RunningSubject, gaps: FloatArray) -> SpeedRecord:
    drive, problem = subject.drive, subject.problem
    assert subject.times is not None
    whole, inside = np.moveaxis(subject.times.selected, -1, 0)
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
        build_s=subject.build_report["build_s"],
        memory_bytes=memory,
        memory_growth_bytes=memory - subject.build_report["before_bytes"],
        whole=whole,
        **time_statistics(whole, inside),
    )


def _active_share(command: FloatArray, config: ControllerConfig) -> float:
    """Compute the share of ticks at which a command is at a limit of range or slew [-]."""
    increment = np.diff(command, axis=0, prepend=np.zeros((1, 2)))
    box = np.array([config.limits.v, config.limits.omega])
    slew = slew_step(config.limits, config.sample_time)
    at_limit = (np.abs(command) > box - _LIMIT_TOLERANCE) | (np.abs(increment) > slew - _LIMIT_TOLERANCE)
    return float(at_limit.any(axis=1).mean())


def _folder_name(name: str) -> str:
    return name.replace("/", "-")
