"""Hook by which features attach to a controller.

A package registers a subclass of `Feature` as an entry point of the group `diffdrive_mpc.features`. The name of the
entry is that of the feature and of its configuration group `expert.<name>`.
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
    """Access of a feature to its controller, which updates the attributes.

    Attributes
    ----------
    config
        Configuration in force.
    model
        Model that the controller predicts with.
    tick
        Compiled core.
    pursuit
        Reference with its clock, or the path back to it.
    terms
        All terms of the cost.
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
    """Base of all features; a feature overrides the methods that it needs.

    Parameters
    ----------
    config
        Configuration that enables the feature.
    model
        Model that the controller starts with.

    Attributes
    ----------
    schema
        Schema of the configuration group; its `is_enabled` decides whether the feature is attached.
    restarts_on_switch
        True if switching to another reference restarts the drive.
    """

    schema: ClassVar[type[FeatureGroup]] = FeatureGroup
    restarts_on_switch: ClassVar[bool] = False

    def __init__(self, config: ControllerConfig, model: VelocityModel | NonlinearModel) -> None:
        del config, model

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """Return the configuration with the changes that the feature needs; raises ConfigError if it cannot be used."""
        return config

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Return the terms that the feature adds to the cost."""
        del config
        return ()

    def attach(self, host: Host) -> None:
        """Keep access to the controller, which is complete now."""
        self.host = host

    def configure(self) -> None:
        """Adopt the configuration of `host` after a change."""

    def begin(self, reference: Reference, t0: float) -> Reference:
        """Start a reference with its time 0 at `t0` [s]; return the reference to track in its place."""
        del t0
        return reference

    def lay(self, reference: Reference) -> Reference:
        """Return a checked reference as it will be driven."""
        return reference

    def forget(self) -> None:
        """Reset the feature, for a robot at standstill."""

    def set_applied(self, command: FloatArray) -> None:
        """Replace the last command (2,) by that of another controller."""

    def before_step(self, t: float) -> Hold | None:
        """Prepare the tick at `t` [s]; return a reason to stand, if there is one."""
        del t
        return None

    def after_step(self, t: float, measurement: Measurement, result: StepResult) -> StepResult:
        """Return the result of the tick at `t` [s], changed or not."""
        del t, measurement
        return result

    def state(self) -> Any:  # noqa: ANN401 - each feature has its own state
        """Return the state that a pickled controller takes along; None without one."""
        return None

    def restore(self, state: Any) -> None:  # noqa: ANN401 - as above
        """Continue from a state that `state` returned, before the reference starts again."""
        del state
