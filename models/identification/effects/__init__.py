"""Identification of nonlinear effects of the base, in addition to its linear dynamics, from records."""

from diffdrive_mpc.models.identification.effects.base import IdentifiedBase, identify_with_effects
from diffdrive_mpc.models.identification.effects.selection import EffectTrial

__all__ = ["EffectTrial", "IdentifiedBase", "identify_with_effects"]
