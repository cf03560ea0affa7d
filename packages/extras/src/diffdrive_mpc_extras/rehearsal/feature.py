"""Feature of a controller that learns from laps, by the errors or by the slip of the surface."""

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
    """Feature that learns from laps; methods as in `Feature`.

    Attributes
    ----------
    learned
        Learner of the correction of a repeated reference, or of the slip of the surface.
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
        self._set_start_slip()

    def start(self, reference: Reference, t0: float) -> Reference:
        """Start as `Feature` describes, and return the reference with the learned correction."""
        tracked = self.learned.start(reference, t0)
        self._set_start_slip()
        return tracked

    def reset(self) -> None:
        """Reset as `Feature` describes."""
        self.learned.forget()
        self._set_start_slip()

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Record the tick as `Feature` describes."""
        return self.learned.take(t, measurement, result)

    def _set_start_slip(self) -> None:
        """Start the next estimate with the learned slip of the surface."""
        if isinstance(self.learned, FloorRehearsal):
            self.host.tick.set_initial_slip(astuple(self.learned.slip))
