"""Torques of both sides as functions of the turn radius, learned while driving."""

from diffdrive_mpc_extras.torque.mran import MranNetwork, MranSettings, TorqueSettings, load_torque_settings
from diffdrive_mpc_extras.torque.torque_curves import TorqueCurves

__all__ = ["MranNetwork", "MranSettings", "TorqueCurves", "TorqueSettings", "load_torque_settings"]
