"""Base class of features that attach to a controller.

A package registers a subclass of `Feature` as an entry point of the group `diffdrive_mpc.features`. The name of the
entry point is the name of the feature and of its configuration group, `expert.<name>`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference
from diffdrive_mpc.models.nonlinear_model import NonlinearModel
from diffdrive_mpc.models.velocity_model import VelocityModel
from diffdrive_mpc.mpc.config.group import FeatureGroup
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.core.tick import Tick
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.terms import Term
from diffdrive_mpc.mpc.reentry import Pursuit
from diffdrive_mpc.mpc.step_result import StepResult


@dataclass
class Host:
    """Interface of a feature to its controller, which updates the attributes.

    Attributes
    ----------
    config
        Current configuration.
    model
        Prediction model of the controller.
    tick
        Compiled core.
    pursuit
        Selector of the target, with the reference's clock.
    terms
        All terms of the cost and of the soft limits.
    is_new_tick
        Function that returns True if the last step advanced the tick.
    t0
        Time 0 of the reference on the clock of `step` [s].
    """

    config: ControllerConfig
    model: VelocityModel | NonlinearModel
    tick: Tick
    pursuit: Pursuit
    terms: Sequence[Term]
    is_new_tick: Callable[[], bool]
    t0: float = 0.0


class Feature:
    """Base class of features; a feature overrides the methods that it needs.

    Parameters
    ----------
    config
        Configuration that enables the feature.
    model
        Initial prediction model of the controller.

    Attributes
    ----------
    schema
        Schema of the configuration group; its `is_enabled` decides whether the feature is attached.
    restarts_on_switch
        True if a switch to another reference restarts the drive.
    """

    schema: ClassVar[type[FeatureGroup]] = FeatureGroup
    restarts_on_switch: ClassVar[bool] = False

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        del config, model

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """Return the configuration with the changes that the feature requires.

        Raises ConfigError if the feature cannot be used with this configuration.
        """
        return config

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Return the terms that the feature adds to the problem."""
        del config
        return ()

    def attach(self, host: Host) -> None:
        """Store the interface to the controller after its construction."""
        self.host = host

    def configure(self) -> None:
        """Apply the configuration of `host` after a change."""

    def start(self, reference: Reference, t0: float) -> Reference:
        """Prepare for the start of `reference` at `t0` [s]; return the reference that the robot tracks instead."""
        del t0
        return reference

    def modify_reference(self, reference: Reference) -> Reference:
        """Return the reference that the robot tracks instead of the checked `reference`."""
        return reference

    def reset(self) -> None:
        """Reset the feature while the robot is at standstill."""

    def set_applied(self, command: FloatArray) -> None:
        """Replace the last command by the applied `command` (2,) of another controller."""

    def before_step(self, t: float) -> Hold | None:
        """Prepare the tick at `t` [s]; return a hold if the robot must stop, else None."""
        del t
        return None

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Return the result of the tick at `t` [s], possibly modified by the feature."""
        del t, measurement
        return result

    def state(self) -> Any:  # noqa: ANN401 - each feature has its own state
        """Return the state of the feature for a pickled controller; None if there is no state."""
        return None

    def restore(self, state: Any) -> None:  # noqa: ANN401 - each feature has its own state
        """Restore a state returned by `state`, before the reference is restarted."""
        del state
