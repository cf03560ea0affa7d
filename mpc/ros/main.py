"""Entry point of the node's process; after a signal, the robot brakes and the last command is zero."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping, Sequence
from types import FrameType

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from threadpoolctl import threadpool_limits

from diffdrive_mpc.models.errors import DiffdriveMpcError
from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.settings import NodeSettings

# Maximum duration of a wait for the executor [s], which limits the response time to a signal.
_MAX_WAIT = 0.1
# Exit code for invalid input, equal to that of the command line.
_BAD_INPUT = 2


def run(
    arguments: Sequence[str],
    settings: NodeSettings | None = None,
    overrides: Mapping[str, object] | None = None,
) -> None:
    """Run the node until SIGINT, SIGTERM or SIGHUP; a second signal cancels the braking ramp.

    Parameters
    ----------
    arguments
        Arguments of ROS, such as `--ros-args -r cmd_vel:=/base/cmd_vel`.
    settings
        Defaults of the node's parameters, except those of the controller.
    overrides
        Values of the controller's configuration by dotted key; they override the file.

    Raises
    ------
    ValueError
        If an argument or a parameter is invalid, or the node fails to start with autostart; the message is one line.
    """
    # The signal handlers of rclpy would end all communication before the zero command is sent.
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # base class of the errors of rclpy, which have no public names
        reason = " ".join(str(error).split())
        raise ValueError(f"ROS cannot start with the arguments '{' '.join(arguments)}': {reason}") from error
    signals: list[int] = []

    def record_signal(number: int, _: FrameType | None) -> None:
        signals.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, record_signal)
    executor = SingleThreadedExecutor()
    try:
        try:
            node = TrackingNode(settings, dict(overrides or {}))
        except ParameterException as error:
            raise ValueError(str(error)) from error
        executor.add_node(node)
        try:
            node.bring_up()
            # The matrices are small, so several threads would be slower; their wake-up takes up to half a tick.
            with threadpool_limits(limits=1):
                while not signals:
                    executor.spin_once(timeout_sec=_MAX_WAIT)
                # Use the computer's clock, since the node's clock may have stopped.
                end = time.monotonic() + node.brake(f"{signal.Signals(signals[0]).name}: the node is shut down")
                while node.is_moving and len(signals) == 1 and (rest := end - time.monotonic()) > 0.0:
                    executor.spin_once(timeout_sec=min(rest, _MAX_WAIT))
        except ExternalShutdownException:
            pass
        finally:
            node.stop()
            node.destroy_node()
    finally:
        executor.shutdown()
        rclpy.try_shutdown()


def main() -> None:
    """Run the node with ROS parameters only; entry point of the colcon package."""
    try:
        run(sys.argv)
    except (ValueError, OSError, DiffdriveMpcError) as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(_BAD_INPUT)
