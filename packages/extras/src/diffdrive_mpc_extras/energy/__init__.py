"""Energy of driving: motor constants from a log, and predictions from them."""

from diffdrive_mpc_extras.energy.identification import IdentifiedConstants, identify_constants, logged_energy

__all__ = ["IdentifiedConstants", "identify_constants", "logged_energy"]
