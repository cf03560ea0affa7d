"""Timing of the simulated base: clocks, lock step with a controller, and real-time mode.

In lock step, each tick publishes the sensor data, then /clock, and waits for the command of the tick.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.simulated_base import LockStep, RealTime, SimulatedBase

Spin = Callable[[float], None]
"""Function that handles at most one message and waits for at most the given time [s]."""


class SteppedClock:
    """Clock that advances by whole samples, published on /clock.

    Attributes
    ----------
    origin
        Clock time of the plant's time 0 [ns].

    Parameters
    ----------
    first_tick
        Number of samples on the clock at the plant's time 0.
    sample_time
        Sample time [s].
    """

    def __init__(self, first_tick: int, sample_time: float) -> None:
        self._sample = sample_time
        # Timers of nodes start at 0, so they fire at the ticks only if the origin is a whole number of samples.
        self.origin = round(1e9 * first_tick * sample_time)
        self._now = self.origin

    def __call__(self) -> int:
        """Return the time of the current tick [ns]."""
        return self._now

    def set_tick(self, tick: int) -> int:
        """Set the clock to a tick, which may be negative, and return its time [ns]."""
        self._now = self.origin + round(1e9 * tick * self._sample)
        return self._now


class WallClock:
    """Monotonic clock that starts at the system time.

    Attributes
    ----------
    origin
        Clock time of the plant's time 0 [ns]; it increases if lost time is skipped.
    """

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self.origin = self()

    def __call__(self) -> int:
        """Return the current time [ns]."""
        return time.monotonic_ns() + self._offset


class CommandPeriodCheck:
    """Detector of a controller whose period is longer than that of the robot, so that some ticks have no command."""

    def __init__(self) -> None:
        self._ticks: list[int] = []
        self._reported = False

    def is_slower(self, tick: int, *, has_command: bool) -> bool:
        """Record whether a tick had a command; return True once if the controller has a longer period."""
        if has_command:
            self._ticks = [*self._ticks[-2:], tick]
        if self._reported or not has_command or len(self._ticks) < 3:
            return False
        first, second, third = self._ticks
        self._reported = second > first + 1 and third > second + 1
        return self._reported

    def message(self, sample_time: float) -> str:
        """Format a warning with the period of the commands, the sample time of the robot [s] and a remedy."""
        period = 0.5 * (self._ticks[-1] - self._ticks[0]) * sample_time
        return (
            f"lock step: commands arrive approximately every {1e3 * period:.3g} ms, but the robot's sample time is "
            f"{1e3 * sample_time:.4g} ms, so the robot waits at each tick without a command; start the robot with the "
            "node's configuration (--config FILE)"
        )


def drive_in_lock_step(
    base: SimulatedBase, clock: SteppedClock, settings: LockStep, spin: Spin, is_running: Callable[[], bool]
) -> None:
    """Drive until `is_running` returns False.

    The clock does not advance until a publisher of commands is connected. Each tick then waits for its command until
    the answer timeout, or until the repeat time of the clock if the publisher has disconnected. After the end of the
    controller, the simulation therefore continues slowly, and the base stops after its command timeout.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot is lost.
    """
    clock_publisher = base.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    # The clock starts one sample before the first tick, so that a timer that fires now fires again at the first tick.
    start = messages.clock(clock.set_tick(-1))
    _wait_for_connections(base, lambda: clock_publisher.publish(start), settings, spin, is_running)
    period_check = CommandPeriodCheck()
    while is_running():
        now = clock.set_tick(base.tick)
        base.publish_sensors(now, clock.origin)
        _wait_for_command(base, now, clock_publisher.publish, settings, spin, is_running)
        if period_check.is_slower(base.tick, has_command=base.inbox.has_command_for(now)):
            base.node.get_logger().warning(period_check.message(base.plant.sample_time))
        base.advance(now)


def _wait_for_connections(
    base: SimulatedBase, publish: Callable[[], None], settings: LockStep, spin: Spin, is_running: Callable[[], bool]
) -> None:
    """Wait for a publisher of commands and, until the answer timeout, for a subscriber of odometry.

    The function returns after the settling time without a new connection, so that all nodes receive the first tick.
    """
    if not base.has_command_publisher:
        base.node.get_logger().info(f"lock step: waiting for a publisher of commands on {base.command_topic}")
    deadline: float | None = None
    connected: tuple[int, ...] = ()
    settled_time = math.inf
    while is_running():
        real_time = time.monotonic()
        if connected != base.connections:
            connected, settled_time = base.connections, real_time + settings.settling_time
        if base.has_command_publisher:
            deadline = deadline or real_time + settings.answer_timeout
            if real_time >= settled_time and (base.has_odometry_subscriber or real_time >= deadline):
                return
        publish()
        while is_running() and (remaining := real_time + settings.clock_repeat - time.monotonic()) > 0:
            spin(remaining)


def _wait_for_command(
    base: SimulatedBase,
    now: int,
    publish: Callable[[object], None],
    settings: LockStep,
    spin: Spin,
    is_running: Callable[[], bool],
) -> None:
    start = repeat = time.monotonic()
    while is_running() and not base.inbox.has_command_for(now):
        real_time = time.monotonic()
        end = start + (settings.answer_timeout if base.has_command_publisher else settings.clock_repeat)
        if real_time >= end:
            break
        if real_time >= repeat:
            publish(messages.clock(now))
            repeat = real_time + settings.clock_repeat
        spin(min(end, repeat) - real_time)


def drive_in_real_time(
    base: SimulatedBase, clock: WallClock, settings: RealTime, spin: Spin, is_running: Callable[[], bool]
) -> None:
    """Drive until `is_running` returns False.

    Like the firmware of the robot, the plant applies a command at its next sample. Stamps are the times of the samples,
    so on a slow computer messages are late but have correct stamps. If the delay relative to real time exceeds
    `settings.most_behind`, the plant skips the lost time.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot is lost.
    """
    sample = base.plant.sample_time
    clock.origin = clock()
    while is_running():
        now = clock.origin + round(1e9 * base.tick * sample)
        while is_running() and (remaining := 1e-9 * (now - clock())) > 0:
            spin(remaining)
        delay = 1e-9 * (clock() - now)
        if delay > settings.most_behind:
            base.node.get_logger().warning(f"{delay:.2f} s behind real time: the robot skips this time")
            clock.origin += round(1e9 * delay)
            now += round(1e9 * delay)
        spin(0.0)
        base.publish_sensors(now, clock.origin)
        base.advance(now)
