"""The dead time between the recorded commands and what wheels or gyro answered, whatever the configuration says."""

from __future__ import annotations

from dataclasses import replace

from diffdrive_mpc.app.replay.recording import Tick
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc import ControllerConfig
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.online_dead_time.dead_time import DeadTime
from diffdrive_mpc.mpc.problem.build import chosen_model
from diffdrive_mpc.mpc.step_result import LearnedDeadTime, Mode, StepResult


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
            self._learner = DeadTime(replace_values(config, wide), model)

    @property
    def found(self) -> LearnedDeadTime | None:
        """What was learned so far; None without a linear model."""
        return None if self._learner is None else self._learner.found

    def take(self, tick: Tick, step: StepResult) -> None:
        """Learn from a tick at which the recorded command was sent, and the controller said `step`."""
        if self._learner is None:
            return
        if tick.start is not None and tick.start.reset:
            found = self._learner.found
            self._learner.forget()
            self._learner.found = found
        driven = replace(step, command=tick.command, mode=Mode.TRACKING, blocked_for=0.0)
        self._learner.take(tick.time, tick.measurement, driven)
