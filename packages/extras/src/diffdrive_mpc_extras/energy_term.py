"""Energy of turns in a controller: a cost term, and the minimum radius that the motor torque allows."""

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
    """Settings of the energy of turns on a surface, and of its use in the plan."""

    weight: NotNegative = Field(
        0.0, description="weight of the electrical power of turning, summed over the horizon; 0 disables the term [1/W]"
    )
    turn_costs: str = Field("", description="name of shipped turn costs, or path of a file from the command torque [-]")
    use_min_radius: bool = Field(
        False,
        description="take limits.min_commanded_radius from the turn costs, at the speed of their table, if it is not "
        "set [-]",
    )

    @model_validator(mode="after")
    def _check_costs(self) -> Self:
        if (self.weight or self.use_min_radius) and not self.turn_costs:
            raise ValueError("turn_costs: give a shipped name, such as fsu_bot-default, or a file written by torque")
        return self

    @property
    def is_enabled(self) -> bool:
        """True if the configuration weighs the energy of turns or takes the radius from the turn costs."""
        return bool(self.weight) or self.use_min_radius

    def relative_to(self, folder: Path) -> Energy:
        """Return the group with turn costs from `folder`, if it has a file of this name."""
        path = folder / self.turn_costs
        if not self.turn_costs or Path(self.turn_costs).is_absolute() or not is_file(path):
            return self
        return self.model_copy(update={"turn_costs": str(path)})

    def check_files(self) -> None:
        """Raise UntrustedFileError or ConfigError if the turn costs cannot be read."""
        from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415 - loads CasADi

        if self.turn_costs:
            load_turn_costs(self.turn_costs)


def energy_settings(config: ControllerConfig) -> Energy:
    """Return the energy settings of a configuration, by default those of `Energy`."""
    return config.feature_group("energy", Energy)


NAME = "energy"
"""Name of the term; the weight [1/W] is its only stage parameter."""

# Smoothing of the residual around straight motion, in power [W] and yaw rate [rad/s]: the square root of the power has
# a kink there.
_SMOOTHING_POWER, _SMOOTHING_YAW_RATE = 0.05, 0.02


def turning_power(costs: TurnCosts, v: ca.SX, omega: ca.SX) -> ca.SX:
    """Compute the battery power of a command minus that of straight motion at the same speed [W].

    The power of straight motion is subtracted because the plan cannot save it: it depends on the path length only.
    """
    return ca.SX(costs.symbolic_power(v, omega) - costs.symbolic_power(v, ca.SX(0.0)))


def energy_function(costs: TurnCosts) -> ca.Function:
    """Build the residual of a command (2) and the weight [1/W]: its square is the weight times the turning power.

    The residual has the sign of the yaw rate. It is smooth and increasing at small yaw rates, so the Gauss-Newton step
    uses the true gradient of the power and a curvature that is never negative.
    """
    command, weight = ca.SX.sym("command", 2), ca.SX.sym("parameters", 1)
    omega = command[1]
    power = turning_power(costs, command[0], omega)
    smoothed_power = 0.5 * (power + ca.sqrt(power**2 + _SMOOTHING_POWER**2))
    residual = ca.sqrt(weight * smoothed_power) * omega / ca.sqrt(omega**2 + _SMOOTHING_YAW_RATE**2)
    return ca.Function(NAME, [command, weight], [residual], ["command", "parameters"], ["residual"])


def energy_terms(config: ControllerConfig) -> tuple[Term, ...]:
    """Build the cost term of a configuration; return an empty tuple if the weight is zero."""
    if not energy_settings(config).weight:
        return ()
    function = energy_function(_load(config))
    return (Term(NAME, function, "residual", defaults=(energy_settings(config).weight,)),)


def with_min_radius(config: ControllerConfig) -> ControllerConfig:
    """Return the configuration with the minimum radius of the turn costs, if `use_min_radius` is set and no radius is.

    Raises
    ------
    ConfigError
        If the turn costs do not exist, or the motor torque is insufficient for every turn.
    """
    if not energy_settings(config).use_min_radius or config.limits.min_commanded_radius is not None:
        return config
    costs = _load(config)
    radius = costs.least_radius()
    if math.isinf(radius):
        raise ConfigError(
            f"expert.energy.use_min_radius: the turn costs '{costs.name}' give a motor torque above the limit for every"
            " turn; set limits.min_commanded_radius, or use other turn costs"
        )
    if radius == 0.0:
        return config
    limits = config.limits.model_copy(update={"min_commanded_radius": radius})
    return config.model_copy(update={"limits": limits})


def _load(config: ControllerConfig) -> TurnCosts:
    from diffdrive_mpc_extras.turn_costs import load_turn_costs  # noqa: PLC0415 - loads CasADi

    return load_turn_costs(energy_settings(config).turn_costs)


class EnergyFeature(Feature):
    """Feature `energy`."""

    schema = Energy

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """Return the configuration with the minimum radius of the turn costs."""
        return with_min_radius(config)

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """Build the energy term of a configuration."""
        return energy_terms(config)
