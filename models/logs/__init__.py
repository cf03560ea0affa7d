"""Reading and checking of robot logs from CSV files and ROS 2 bags as evenly sampled records."""

from typing import TYPE_CHECKING

from diffdrive_mpc.models.lazy_names import on_first_use
from diffdrive_mpc.models.logs.record import Finding, Log, Record

if TYPE_CHECKING:
    from diffdrive_mpc.models.logs.reading import read_log

__all__ = ["Finding", "Log", "Record", "read_log"]
__getattr__, _ = on_first_use(__name__, {"read_log": "reading"})
