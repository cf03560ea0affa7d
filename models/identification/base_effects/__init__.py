"""What a base does around its linear dynamics, estimated from records."""

from diffdrive_mpc.models.identification.base_effects.identified_base import IdentifiedBase
from diffdrive_mpc.models.identification.base_effects.identify import identify_with_effects
from diffdrive_mpc.models.identification.base_effects.selection import Trial

__all__ = ["IdentifiedBase", "Trial", "identify_with_effects"]
