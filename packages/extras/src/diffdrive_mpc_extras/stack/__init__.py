"""Parameter files of ros2_control, Nav2 and robot_localization from logs: `identify --for PACKAGE`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from diffdrive_mpc.models.identification.effects import IdentifiedBase
from diffdrive_mpc.models.identification.log_data import LogData
from diffdrive_mpc.models.table import TextTable
from diffdrive_mpc_extras.stack.estimate import Quantities, estimate_stack, quantity_table
from diffdrive_mpc_extras.stack.parameter_files import package_text


@dataclass(frozen=True)
class StackWriter:
    """Writer of the parameter file of one package; all writers use the same estimate."""

    package: str

    def estimate(
        self, data: LogData, limits: Mapping[str, float] | None = None, base: IdentifiedBase | None = None
    ) -> Quantities:
        """Estimate the quantities of a log; see `estimate_stack`."""
        return estimate_stack(data, limits, base)

    def text(self, estimate: Quantities) -> str:
        """Return the parameter file."""
        return package_text(self.package, estimate)

    def table(self, estimate: Quantities) -> TextTable:
        """Return a table with a row for each quantity."""
        return quantity_table(estimate)


NAV2, ROBOT_LOCALIZATION, ROS2_CONTROL = map(StackWriter, ("nav2", "robot_localization", "ros2_control"))
