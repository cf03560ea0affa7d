"""The one hook by which features attach to a controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.tick import Tick
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.terms import Term
from diffdrive_mpc.mpc.reentry import Pursuit
from diffdrive_mpc.mpc.step_result import StepResult


@dataclass
class Host:
    """What a feature may use of its controller, which keeps it as it is now.

    Attributes
    ----------
    config
        In force.
    model
        That it predicts with.
    tick
        The compiled core.
    pursuit
        What is tracked: the reference with its clock, or the way back to it.
    terms
        All terms of the cost.
    is_new_tick
        Whether the last step was one, and no repetition.
    is_preparing
        Goes on with a change of the model by a part of its work; whether one is under way.
    change_dead_time
        Begins to predict with another dead time (2,) [s].
    t0
        Time 0 of the reference on the clock of `step` [s].
    """

    config: ControllerConfig
    model: VelocityModel | NonlinearModel
    tick: Tick
    pursuit: Pursuit
    terms: Sequence[Term]
    is_new_tick: Callable[[], bool]
    is_preparing: Callable[[], bool]
    change_dead_time: Callable[[FloatArray], None]
    t0: float = 0.0


class Feature:
    """A feature; what it does not need it leaves as it is here.

    Parameters
    ----------
    config
        The configuration, which enables it.
    model
        The model that the controller begins with.
    """

    restarts_on_switch = False
    """Whether another reference under way is a new start for it."""

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        del config, model

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """The configuration with what follows from the feature; raises ConfigError where it cannot be used."""
        return config

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Terms that it adds to the cost."""
        del config
        return ()

    def longest(self) -> VelocityModel | None:
        """The model with the most dead time that it may ask for; None where it asks for none."""
        return None

    def attach(self, host: Host) -> None:
        """The controller is built: keep what of it is needed."""
        self.host = host

    def configure(self) -> None:
        """Another configuration or model is in force, see `host`."""

    def begin(self, reference: Reference, t0: float) -> Reference:
        """A reference begins, its time 0 at `t0` [s]; returns the one to track in its place."""
        del t0
        return reference

    def lay(self, reference: Reference) -> Reference:
        """A reference that is tracked from now on, checked; returns it as it will be driven."""
        return reference

    def forget(self) -> None:
        """Be as new, for a robot that stands still."""

    def set_applied(self, command: FloatArray) -> None:
        """Somebody else decided the last command (2,)."""

    def before_step(self, t: float) -> Hold | None:
        """Before the tick at `t` [s]; returns a reason to stand, if there is one."""
        del t
        return None

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """After the tick at `t` [s]; returns its result, perhaps another one."""
        del t, measurement
        return result
