"""Logs of robots as evenly sampled records: CSV files and ROS 2 bags, checked and never silently repaired."""

from diffdrive_mpc.models.logs.reading import read_log
from diffdrive_mpc.models.logs.record import Finding, Log, Record

__all__ = ["Finding", "Log", "Record", "read_log"]
