"""Energy of driving: drive constants from a log, and energy predictions from these constants."""

from diffdrive_mpc_extras.energy.identification import IdentifiedConstants, identify_constants, logged_energy

__all__ = ["IdentifiedConstants", "identify_constants", "logged_energy"]
