"""Rehearsal, attached to a controller: by the reference or by the floor."""

from __future__ import annotations

from dataclasses import astuple

from diffdrive_mpc.models.interface import Measurement, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.problem.feed_forward import FeedForward
from diffdrive_mpc.mpc.step_result import StepResult
from diffdrive_mpc_extras.rehearsal.config import Rehearsal, rehearsal_of
from diffdrive_mpc_extras.rehearsal.floor_rehearsal import FloorRehearsal
from diffdrive_mpc_extras.rehearsal.rehearsal import LapLearner


class Rehearse(Feature):
    """See `Feature`.

    Attributes
    ----------
    learned
        Values learned about a reference that is driven again, or about the floor.
    """

    schema = Rehearsal
    restarts_on_switch = True

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        super().__init__(config, model)
        self.learned: LapLearner | FloorRehearsal
        if rehearsal_of(config).by == "floor":
            self.learned = FloorRehearsal(config, FeedForward.from_model(model, config.sample_time).inverse_gain)
        else:
            self.learned = LapLearner(config)

    def configure(self) -> None:
        """Configure as `Feature` describes."""
        if isinstance(self.learned, FloorRehearsal):
            self.learned.config = self.host.config
        self._begin_with_slip()

    def begin(self, reference: Reference, t0: float) -> Reference:
        """Start as `Feature` describes: move the reference by the learned correction."""
        tracked = self.learned.start(reference, t0)
        self._begin_with_slip()
        return tracked

    def forget(self) -> None:
        """Forget as `Feature` describes."""
        self.learned.forget()
        self._begin_with_slip()

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick as `Feature` describes."""
        return self.learned.take(t, measurement, result)

    def _begin_with_slip(self) -> None:
        """Start the next estimate with the slip learned of the floor."""
        if isinstance(self.learned, FloorRehearsal):
            self.host.tick.begin_with(astuple(self.learned.slip))
