"""Execution of the simulated robot as a ROS 2 node."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType

import rclpy
from numpy.typing import ArrayLike
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.sim.plants.plant import Plant
from diffdrive_mpc.sim.ros.messages import Storage, bag_recorder
from diffdrive_mpc.sim.ros.pace import SteppedClock, WallClock, drive_in_lock_step, drive_in_real_time
from diffdrive_mpc.sim.ros.simulated_base import BaseSettings, SimulatedBase
from diffdrive_mpc.sim.sensing.sensor_set import SensorSet

NODE_NAME = "simulated_robot"


def run_robot(
    plant: Plant,
    start: ArrayLike,
    settings: BaseSettings,
    sensors: SensorSet,
    *,
    correction: tuple[float, float] = (1.0, 1.0),
    lock_step: bool = False,
    duration: float | None = None,
    record: Path | None = None,
    storage: Storage = "mcap",
    ros_arguments: Sequence[str] = (),
    driver: str = "",
) -> None:
    """Reset `plant` to `start`, and run it as a ROS node until SIGINT, SIGTERM, SIGHUP or the end of `duration`.

    The function must be called from the main thread, which receives signals.

    Parameters
    ----------
    plant
        Simulated robot.
    start
        (3,) x [m], y [m], theta [rad] in map.
    settings
        Rates, timeouts and command type.
    sensors
        Sensor set of the plant, which defines the latency of poses.
    correction
        Ratios of the readings of wheels and gyro to speed and yaw rate, which the odometry pose corrects [-].
    lock_step
        True to publish /clock and wait for the command of each tick; otherwise the base runs in real time.
    duration
        Duration on the robot's clock [s]; None for no limit.
    record, storage
        Folder of a bag for the recording, and its storage format.
    ros_arguments
        ROS arguments, which start with `--ros-args`.
    driver
        Command of a node that drives the robot, for the message at the start.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the bag is not writable, or the ROS arguments are invalid.
    sim.plants.plant.RobotLostError
        If the robot tips over or its motion diverges.
    """
    with ExitStack() as stack:
        is_running = stack.enter_context(_run_until_end(plant, duration))
        node, spin = stack.enter_context(_ros_node(ros_arguments))
        recorder = None if record is None else stack.enter_context(bag_recorder(record, storage))
        clock: SteppedClock | WallClock = (
            SteppedClock(settings.lock_step.first_tick, plant.sample_time) if lock_step else WallClock()
        )
        memory = math.ceil(sensors.pose.latency / plant.sample_time)
        base = SimulatedBase(
            node, plant, start, settings, pose_memory=memory, clock=clock, record=recorder, correction=correction
        )
        commands = f"commands, such as those of: {driver}" if driver else "commands"
        node.get_logger().info(f"ready, in {'lock step' if lock_step else 'real time'}; waiting for {commands}")
        if isinstance(clock, SteppedClock):
            drive_in_lock_step(base, clock, settings.lock_step, spin, is_running)
        else:
            drive_in_real_time(base, clock, settings.real_time, spin, is_running)


@contextmanager
def _run_until_end(plant: Plant, duration: float | None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True until `duration` or a signal ends the run."""
    has_ended = False

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal has_ended
        has_ended = True

    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    end_time = math.inf if duration is None else duration
    try:
        # The times of ticks have rounding errors, so the comparison has a tolerance of half a sample.
        yield lambda: not has_ended and plant.time < end_time - 0.5 * plant.sample_time
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def _ros_node(arguments: Sequence[str]) -> Iterator[tuple[Node, Callable[[float], None]]]:
    """Yield a node, and a function that handles at most one of its messages."""
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # base class of the errors of rclpy, which are not public
        reason = " ".join(str(error).split())
        raise ConfigError(f"ROS cannot start with the arguments '{' '.join(arguments)}': {reason}") from error
    try:
        node = rclpy.create_node(NODE_NAME)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            yield node, lambda seconds: executor.spin_once(timeout_sec=seconds)
        finally:
            executor.shutdown()
            node.destroy_node()
    finally:
        rclpy.shutdown()
