"""Energy of turns in a controller: a term of the cost, and the least radius by the motors' torque."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Self

import casadi as ca
from pydantic import Field, model_validator

from diffdrive_mpc import Term
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.named_file import is_file
from diffdrive_mpc.mpc.config.group import FeatureGroup, NotNegative
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.features.feature import Feature

if TYPE_CHECKING:
    from diffdrive_mpc_extras.turn_costs import TurnCosts


class Energy(FeatureGroup):
    """Settings of the energy of turns on a floor, and its use in the plan."""

    weight: NotNegative = Field(
        0.0, description="electrical power that turning takes, summed over the steps of the horizon; 0: no matter [1/W]"
    )
    turn_costs: str = Field("", description="name of shipped turn costs or path of a file, as torque writes it [-]")
    use_min_radius: bool = Field(
        False,
        description="take limits.min_commanded_radius from the turn costs, at the speed of their table, where it is "
        "not given [-]",
    )

    @model_validator(mode="after")
    def _has_costs(self) -> Self:
        if (self.weight or self.use_min_radius) and not self.turn_costs:
            raise ValueError("turn_costs: give a file; shipped are fsu_bot-default and others, torque writes yours")
        return self

    @property
    def is_enabled(self) -> bool:
        """True if the configuration weighs turns or takes the radius from their costs."""
        return bool(self.weight) or self.use_min_radius

    def relative_to(self, folder: Path) -> Energy:
        """Return the group with turn costs of `folder`, if a file there has their name."""
        path = folder / self.turn_costs
        if not self.turn_costs or Path(self.turn_costs).is_absolute() or not is_file(path):
            return self
        return self.model_copy(update={"turn_costs": str(path)})

    def check_files(self) -> None:
        """Raise UntrustedFileError or ConfigError if the turn costs cannot be read."""
        from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415 - loads CasADi

        if self.turn_costs:
            load_turn_costs(self.turn_costs)


def energy_of(config: ControllerConfig) -> Energy:
    """Return the group of a configuration, with its defaults if the configuration does not name it."""
    return config.feature_group("energy", Energy)


# The power that turning takes as a residual of the cost, and the least radius that motors have torque for.


NAME = "energy"
"""Name of the term; its one stage parameter is the weight [1/W]."""

# Power [W] and yaw rate [rad/s] over which the residual goes through zero where the robot drives straight on: the root
# of a power would have a kink there.
_SOFT_POWER, _SOFT_YAW_RATE = 0.05, 0.02


def turning_power(costs: TurnCosts, v: ca.SX, omega: ca.SX) -> ca.SX:
    """Compute the battery power of a command beyond that of straight motion at the same speed [W].

    That rest, drag over the length of the path, is not saved by another curve.
    """
    return ca.SX(costs.symbolic_power(v, omega) - costs.symbolic_power(v, ca.SX(0.0)))


def energy_function(costs: TurnCosts) -> ca.Function:
    """Build the residual of a command (2) and the weight [1/W]: its square is the weight times the turning power.

    It has the sign of the yaw rate, and is smooth and increasing where that is small: so the Gauss-Newton step sees the
    true gradient of the power, and a curvature that is never negative.
    """
    command, weight = ca.SX.sym("command", 2), ca.SX.sym("parameters", 1)
    omega = command[1]
    power = turning_power(costs, command[0], omega)
    positive = 0.5 * (power + ca.sqrt(power**2 + _SOFT_POWER**2))
    residual = ca.sqrt(weight * positive) * omega / ca.sqrt(omega**2 + _SOFT_YAW_RATE**2)
    return ca.Function(NAME, [command, weight], [residual], ["command", "parameters"], ["residual"])


def energy_terms(config: ControllerConfig) -> tuple[Term, ...]:
    """Build the term of a configuration; none with a weight of zero."""
    if not energy_of(config).weight:
        return ()
    function = energy_function(_load(config))
    return (Term(NAME, function, "residual", defaults=(energy_of(config).weight,)),)


def with_least_radius(config: ControllerConfig) -> ControllerConfig:
    """Return the configuration with the least commanded radius of its turn costs, if it requests and lacks one.

    Raises
    ------
    ConfigError
        If there are no such turn costs, or the robot has no torque for any turn.
    """
    if not energy_of(config).use_min_radius or config.limits.min_commanded_radius is not None:
        return config
    costs = _load(config)
    radius = costs.least_radius()
    if math.isinf(radius):
        raise ConfigError(
            f"expert.energy.use_min_radius: by the turn costs '{costs.name}' the motors have no torque for any turn; "
            "give limits.min_commanded_radius, or other turn costs"
        )
    if radius == 0.0:
        return config
    limits = config.limits.model_copy(update={"min_commanded_radius": radius})
    return config.model_copy(update={"limits": limits})


def _load(config: ControllerConfig) -> TurnCosts:
    from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415 - most configurations name none

    return load_turn_costs(energy_of(config).turn_costs)


class EnergyFeature(Feature):
    """See `Feature`."""

    schema = Energy

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """Prepare the configuration as `Feature` describes, with the least radius of the turn costs."""
        return with_least_radius(config)

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Build the terms as `Feature` describes."""
        return energy_terms(config)
