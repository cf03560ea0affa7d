"""Identification of a velocity model, a controller configuration and a report from logs of a robot."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use

if TYPE_CHECKING:
    from diffdrive_mpc.models.identification.from_logs import Identification, identify

__all__ = ["Identification", "identify"]
__getattr__, __dir__ = on_first_use(__name__, dict.fromkeys(__all__, "from_logs"))
