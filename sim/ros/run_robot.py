"""Run the simulated robot as a ROS 2 node until a signal."""

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
    lock_step: bool = False,
    duration: float | None = None,
    record: Path | None = None,
    storage: Storage = "mcap",
    ros_arguments: Sequence[str] = (),
) -> None:
    """Put `plant` at `start` and let it live on its topics until SIGINT, SIGTERM, SIGHUP or the end of `duration`.

    To be called from the main thread, which signals reach.

    Parameters
    ----------
    plant
        The robot stand-in.
    start
        (3,) x [m], y [m], theta [rad] in map.
    settings
        Rates, timeouts, kind of command.
    sensors
        The plant's sensor set: how late its poses may be.
    lock_step
        Publish /clock and wait for the command to each tick; otherwise the wall clock counts.
    duration
        Time on the robot's clock after which it ends by itself [s]; None to go on.
    record, storage
        Folder of a bag to record to, and its kind.
    ros_arguments
        Arguments from `--ros-args` on.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the bag cannot be written, or the ROS arguments cannot be used.
    sim.plants.plant.RobotLostError
        If the robot tips over or its motion diverges.
    """
    with ExitStack() as stack:
        going = stack.enter_context(_told_to_end(plant, duration))
        node, spin = stack.enter_context(_ros_node(ros_arguments))
        recorder = None if record is None else stack.enter_context(bag_recorder(record, storage))
        clock: SteppedClock | WallClock = (
            SteppedClock(settings.lock_step.first_tick, plant.sample_time) if lock_step else WallClock()
        )
        late = math.ceil(sensors.pose.latency / plant.sample_time)
        base = SimulatedBase(node, plant, start, settings, pose_memory=late, clock=clock, record=recorder)
        node.get_logger().info(f"ready, in {'lock step' if lock_step else 'real time'}")
        if isinstance(clock, SteppedClock):
            drive_in_lock_step(base, clock, settings.lock_step, spin, going)
        else:
            drive_in_real_time(base, clock, settings.real_time, spin, going)


@contextmanager
def _told_to_end(plant: Plant, duration: float | None) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True while the run continues; a signal ends it between samples."""
    ended = False

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal ended
        ended = True

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    last = math.inf if duration is None else duration
    try:
        # Half a sample: times are sums of samples.
        yield lambda: not ended and plant.time < last - 0.5 * plant.sample_time
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _ros_node(arguments: Sequence[str]) -> Iterator[tuple[Node, Callable[[float], None]]]:
    """Yield a node, and a function that handles one of its messages."""
    try:
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # the base of rclpy's errors, which have no public names
        words = " ".join(str(error).split())
        raise ConfigError(f"ROS cannot start with the arguments '{' '.join(arguments)}': {words}") from error
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
