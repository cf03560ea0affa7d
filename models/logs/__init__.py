"""Logs of robots as evenly sampled records: CSV files and ROS 2 bags, checked and never silently repaired."""

from models.logs.record import Finding, Log, Record

__all__ = ["Finding", "Log", "Record"]
