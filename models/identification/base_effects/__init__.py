"""What a base does around its linear dynamics, estimated from records."""

from models.identification.base_effects.identified_base import IdentifiedBase
from models.identification.base_effects.identify import identify_with_effects
from models.identification.base_effects.selection import Trial

__all__ = ["IdentifiedBase", "Trial", "identify_with_effects"]
