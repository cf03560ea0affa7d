"""What turning costs, attached to a controller: a term of the cost, and the least radius by the motors' torque."""

from __future__ import annotations

from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.energy.energy_term import energy_terms, with_least_radius
from diffdrive_mpc.mpc.features.feature import Feature
from diffdrive_mpc.mpc.problem.terms import Term


class Energy(Feature):
    """See `Feature`."""

    @classmethod
    def prepare(cls, config: ControllerConfig) -> ControllerConfig:
        """See `Feature`: with the least radius of the turn costs."""
        return with_least_radius(config)

    @classmethod
    def terms(cls, config: ControllerConfig) -> tuple[Term, ...]:
        """See `Feature`."""
        return energy_terms(config)


FEATURE = Energy
