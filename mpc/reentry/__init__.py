"""Off the path or held up: the path back to the reference, and the waiting clock of the reference."""

from diffdrive_mpc.mpc.reentry.pursuit import Pursuit
from diffdrive_mpc.mpc.reentry.target import Target, TooFar

__all__ = ["Pursuit", "Target", "TooFar"]
