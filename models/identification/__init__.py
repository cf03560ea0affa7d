"""From logs of a robot to a velocity model, a controller configuration and a report."""

from diffdrive_mpc.models.identification.from_logs import Identification, identify

__all__ = ["Identification", "identify"]
