"""Run the monitor as a process: signals end it with zero as its last command."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from types import FrameType

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from diffdrive_mpc_monitor.ros.node import MonitorNode, MonitorSettings

_LONGEST_WAIT = 0.1  # for which a signal may wait [s]


def run(arguments: Sequence[str], settings: MonitorSettings | None = None) -> None:
    """Run the monitor until SIGINT, SIGTERM or SIGHUP.

    Parameters
    ----------
    arguments
        Arguments for ROS, such as `--ros-args -r cmd_vel:=/base/cmd_vel`.
    settings
        Defaults of its parameters.

    Raises
    ------
    ValueError
        If an argument, a parameter or the rules cannot be used; one line.
    """
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # the base of rclpy's errors, which have no public names
        words = " ".join(str(error).split())
        raise ValueError(f"ROS cannot start with the arguments '{' '.join(arguments)}': {words}") from error
    signals: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        signals.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, note)
    executor = SingleThreadedExecutor()
    try:
        try:
            node = MonitorNode(settings)
        except ParameterException as error:
            raise ValueError(str(error)) from error
        executor.add_node(node)
        try:
            while not signals:
                executor.spin_once(timeout_sec=_LONGEST_WAIT)
        except ExternalShutdownException:
            pass
        finally:
            node.stop()
            node.destroy_node()
    finally:
        executor.shutdown()
        rclpy.try_shutdown()
