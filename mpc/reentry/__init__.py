"""Off the path or held up: the way back to the reference, and the reference's clock that waits."""

from diffdrive_mpc.mpc.reentry.pursuit import Pursuit
from diffdrive_mpc.mpc.reentry.target import Target, TooFar

__all__ = ["Pursuit", "Target", "TooFar"]
