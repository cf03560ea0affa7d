"""The ticks of a recording through a controller that believes that the recorded commands went out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from diffdrive_mpc.app.replay.recording import RecordedTick, Recording
from diffdrive_mpc.models.interface import FloatArray, Reference
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import Controller, ControllerConfig
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.estimation.estimate import SENSORS
from diffdrive_mpc.mpc.online_dead_time.dead_time import DeadTimeEstimator
from diffdrive_mpc.mpc.problem.build import chosen_model
from diffdrive_mpc.mpc.step_result import LearnedDeadTime, Mode, StepResult

OnStep = Callable[[RecordedTick, StepResult], None]


@dataclass(frozen=True)
class Replayed:
    """What a controller said at the n ticks of a recording.

    Attributes
    ----------
    config
        Its configuration.
    command
        (n, 2) v [m/s], omega [rad/s] that it would have sent.
    modes, messages, solver_methods, unused
        What it said; of sensors that it did not use their names, with commas between.
    estimate, deviation
        (n, 5) x [m], y [m], theta [rad], v [m/s], omega [rad/s] that it believed, and standard deviations; NaN without.
    aim
        (n, 3) pose that it tracked at the tick; NaN where it did not.
    innovations
        (n, 4) squared innovation over its variance, by `SENSORS`, where the tick brought a reading; else NaN.
    pose_age
        (n,) since the stamp of the last accepted pose [s]; NaN before the first.
    slip
        (n, 2) v offset [m/s] and yaw gain [-] that it believed.
    reference_delay
        (n,) how far the reference's clock was behind [s].
    step_time, solve_time
        (n,) [s].
    """

    config: ControllerConfig
    command: FloatArray
    modes: tuple[str, ...]
    messages: tuple[str, ...]
    solver_methods: tuple[str, ...]
    unused: tuple[str, ...]
    estimate: FloatArray
    deviation: FloatArray
    aim: FloatArray
    innovations: FloatArray
    pose_age: FloatArray
    slip: FloatArray
    reference_delay: FloatArray
    step_time: FloatArray
    solve_time: FloatArray


def replay(
    recording: Recording,
    config: ControllerConfig,
    references: tuple[Reference, ...],
    *,
    as_recorded: bool,
    on_step: OnStep = lambda _tick, _step: None,
) -> Replayed:
    """Ask a fresh controller at every tick of `recording`.

    Parameters
    ----------
    config
        Its configuration.
    references
        What it tracks from each start on.
    as_recorded
        Whether weights and limits change as they did in the drive.
    on_step
        Called after each tick with it and the controller's answer.

    Raises ConfigError or ValueError if the configuration cannot be used, or a reference is beyond its limits.
    """
    controller = Controller(config)
    steps: list[StepResult] = []
    waiting = iter(references)
    for number, tick in enumerate(recording.ticks):
        if tick.start is not None:
            if tick.start.reset and number:
                controller.reset()
            if tick.start.before is not None:
                controller.set_applied_commands(tick.start.before)
            begin = controller.switch_reference if tick.start.goes_on else controller.start
            begin(next(waiting), tick.start.t0)
        if tick.config is not None and as_recorded:
            controller.update(weights=tick.config.weights.model_dump(), limits=_changeable(tick.config))
        steps.append(controller.step(tick.time, tick.measurement, tick.hold, most_iterations=tick.stopped_after))
        if np.isfinite(tick.command).all():
            controller.set_applied_commands([tick.command])
        on_step(tick, steps[-1])
    return _gathered(controller.config, recording, steps)


def _changeable(config: ControllerConfig) -> dict[str, float]:
    return {name: value for name, value in config.limits.model_dump().items() if value is not None}


def _gathered(config: ControllerConfig, recording: Recording, steps: list[StepResult]) -> Replayed:
    estimates = [step.estimate for step in steps]
    nothing = np.full(5, np.nan)
    fresh = np.array(
        [
            [one is not None for one in (m.wheel_twist, m.wheel_twist, m.yaw_rate, m.pose)]
            for m in (tick.measurement for tick in recording.ticks)
        ]
    )
    by_tick = [{} if estimate is None else estimate.innovations for estimate in estimates]
    innovations = np.array([[one.get(sensor, np.nan) for sensor in SENSORS] for one in by_tick])
    return Replayed(
        config,
        np.array([step.command for step in steps]),
        tuple(str(step.mode) for step in steps),
        tuple(step.message for step in steps),
        tuple(str(step.solver.method) for step in steps),
        tuple(", ".join(step.unused_sensors) for step in steps),
        np.array([nothing if e is None else np.append(e.pose, e.twist) for e in estimates]),
        np.array([nothing if e is None else np.append(e.pose_deviation, e.twist_deviation) for e in estimates]),
        np.array([nothing[:3] if step.reference is None else step.reference[0] for step in steps]),
        np.where(fresh, innovations, np.nan),
        np.array([np.nan if e is None else e.pose_age for e in estimates]),
        np.array([nothing[:2] if e is None else (e.slip.v_offset, e.slip.yaw_gain) for e in estimates]),
        np.array([step.reference_delay for step in steps]),
        np.array([step.step_time for step in steps]),
        np.array([step.solve_time for step in steps]),
    )


# The dead time between the recorded commands and what wheels or gyro answered, whatever the configuration says.


class DeadTimeWatch:
    """Learns it tick by tick, as the controller can while driving; says nothing of a model that is no linear one.

    Parameters
    ----------
    config
        With the model whose lag is taken as it is.
    """

    def __init__(self, config: ControllerConfig) -> None:
        model = chosen_model(config, None)
        self._learner = None
        if isinstance(model, VelocityModel):
            # Found up to twice as far as the controller would go: here nothing is driven by it.
            settings = config.online_dead_time
            wide = {"online_dead_time.longer": 2 * settings.longer, "online_dead_time.shorter": 2 * settings.shorter}
            self._learner = DeadTimeEstimator(replace_values(config, wide), model)

    @property
    def found(self) -> LearnedDeadTime | None:
        """What was learned so far; None without a linear model."""
        return None if self._learner is None else self._learner.found

    def take(self, tick: RecordedTick, step: StepResult) -> None:
        """Learn from a tick at which the recorded command was sent, and the controller said `step`."""
        if self._learner is None:
            return
        if tick.start is not None and tick.start.reset:
            learned = self._learner.found
            self._learner.forget()
            self._learner.found = learned
        driven = replace(step, command=tick.command, mode=Mode.TRACKING, blocked_for=0.0)
        self._learner.take(tick.time, tick.measurement, driven)
