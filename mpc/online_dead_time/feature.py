"""Dead time learned while driving, attached to a controller."""

from __future__ import annotations

from dataclasses import replace

from diffdrive_mpc.models.interface import FloatArray, Measurement
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.online_dead_time.dead_time import online_dead_time
from diffdrive_mpc.mpc.step_result import StepResult


class OnlineDeadTimeFeature(Feature):
    """See `Feature`; raises ConfigError if there is no dead time that could change."""

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        super().__init__(config, model)
        self._apply = config.online_dead_time.apply
        self._dead_time = online_dead_time(config, model)

    def longest(self) -> VelocityModel | None:
        """See `Feature`."""
        return self._dead_time.longest if self._apply else None

    def configure(self) -> None:
        """See `Feature`."""
        assert isinstance(self.host.model, VelocityModel)
        self._dead_time.used = self.host.model.dead_time

    def forget(self) -> None:
        """See `Feature`."""
        self._dead_time.forget()

    def set_applied(self, command: FloatArray) -> None:
        """See `Feature`."""
        self._dead_time.set_applied(command)

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Learn from the tick; where the dead time is another one, prepare to predict with it, a part at a tick."""
        words, dead_time = result.message, self._dead_time
        busy = self.host.is_preparing()
        if dead_time.take(t, measurement, result):
            wanted = None if busy else dead_time.wanted(t)
            if wanted is not None:
                self.host.change_dead_time(wanted)
            words = "; ".join(filter(None, (words, dead_time.advice(), dead_time.change(wanted))))
        return replace(result, message=words, dead_time=dead_time.found)


FEATURE = OnlineDeadTimeFeature
