"""Targets for a robot that is off its path or late: paths back to the reference, and the reference's clock."""

from diffdrive_mpc.mpc.reentry.pursuit import Pursuit
from diffdrive_mpc.mpc.reentry.target import Target, TooFar

__all__ = ["Pursuit", "Target", "TooFar"]
