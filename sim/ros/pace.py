"""Timing of the simulated base: clocks, lock step with a controller, and real time.

In lock step, each tick publishes the sensors, then /clock, and waits for the command to the tick.
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
"""Function that handles at most one message and waits at most the given time [s]."""


class SteppedClock:
    """Clock that advances in samples, as published on /clock.

    Attributes
    ----------
    origin
        Clock time of the plant's time 0 [ns].

    Parameters
    ----------
    first_tick
        Samples on the clock at the plant's time 0.
    sample_time
        Sample time [s].
    """

    def __init__(self, first_tick: int, sample_time: float) -> None:
        self._sample = sample_time
        # A whole number of samples, so that a node's timer, which counts from 0, fires on the ticks.
        self.origin = round(1e9 * first_tick * sample_time)
        self._now = self.origin

    def __call__(self) -> int:
        """Return the time of the current tick [ns]."""
        return self._now

    def set_tick(self, tick: int) -> int:
        """Set the clock to a tick, which may be before the first one, and return its time [ns]."""
        self._now = self.origin + round(1e9 * tick * self._sample)
        return self._now


class WallClock:
    """Monotonic clock that starts at the system time.

    Attributes
    ----------
    origin
        Clock time of the plant's time 0 [ns]; advances when lost time is skipped.
    """

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self.origin = self()

    def __call__(self) -> int:
        """Return the current time [ns]."""
        return time.monotonic_ns() + self._offset


class CommandRhythm:
    """Detector of a controller with a longer period than the robot: every command is followed by ticks without one."""

    def __init__(self) -> None:
        self._answered: list[int] = []
        self._reported = False

    def differs(self, tick: int, *, answered: bool) -> bool:
        """Record whether a tick had a command; return True, once, if the controller has a longer period."""
        if answered:
            self._answered = [*self._answered[-2:], tick]
        if self._reported or not answered or len(self._answered) < 3:
            return False
        first, second, third = self._answered
        self._reported = second > first + 1 and third > second + 1
        return self._reported

    def words(self, sample_time: float) -> str:
        """Describe the fault, both periods [s] and the remedy."""
        period = 0.5 * (self._answered[-1] - self._answered[0]) * sample_time
        return (
            f"lock step: commands come about every {1e3 * period:.3g} ms, the robot's sample time is "
            f"{1e3 * sample_time:.4g} ms: it waits at each tick without a command; start it with the node's "
            "configuration (--config FILE)"
        )


def drive_in_lock_step(
    base: SimulatedBase, clock: SteppedClock, settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` returns False.

    The clock does not advance until a publisher of commands is connected. Then every tick waits for its command, at
    most for the answer timeout, or for the repeat time of the clock if no publisher is connected any more: after the
    controller has stopped, the robot continues slowly, and the command timeout acts.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot is lost.
    """
    ticker = base.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    # One sample before the first tick, so that a timer that fires now fires again on the first tick.
    before = messages.clock(clock.set_tick(-1))
    _wait_for_connections(base, lambda: ticker.publish(before), settings, spin, going)
    rhythm = CommandRhythm()
    while going():
        now = clock.set_tick(base.tick)
        base.publish_sensors(now, clock.origin)
        _wait_for_answer(base, now, ticker.publish, settings, spin, going)
        if rhythm.differs(base.tick, answered=base.inbox.answers(now)):
            base.node.get_logger().warning(rhythm.words(base.plant.sample_time))
        base.advance(now)


def _wait_for_connections(
    base: SimulatedBase, publish: Callable[[], None], settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Wait until commands have a publisher and, for a limited time, until odometry has a subscriber.

    Then wait until no topic has connected for the settling time, so that all nodes receive the first tick.
    """
    if not base.commanded:
        base.node.get_logger().info(f"lock step: waiting for a publisher of commands on {base.command_topic}")
    deadline: float | None = None
    connected: tuple[int, ...] = ()
    settled = math.inf
    while going():
        moment = time.monotonic()
        if connected != base.connections:
            connected, settled = base.connections, moment + settings.settling_time
        if base.commanded:
            deadline = deadline or moment + settings.answer_timeout
            if moment >= settled and (base.observed or moment >= deadline):
                return
        publish()
        while going() and (left := moment + settings.clock_repeat - time.monotonic()) > 0:
            spin(left)


def _wait_for_answer(
    base: SimulatedBase,
    now: int,
    publish: Callable[[object], None],
    settings: LockStep,
    spin: Spin,
    going: Callable[[], bool],
) -> None:
    start = repeat = time.monotonic()
    while going() and not base.inbox.answers(now):
        moment = time.monotonic()
        end = start + (settings.answer_timeout if base.commanded else settings.clock_repeat)
        if moment >= end:
            break
        if moment >= repeat:
            publish(messages.clock(now))
            repeat = moment + settings.clock_repeat
        spin(min(end, repeat) - moment)


def drive_in_real_time(
    base: SimulatedBase, clock: WallClock, settings: RealTime, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` returns False.

    Like the robot's firmware, the plant applies a command at its next sample. Stamps are the times of the samples: on a
    slow machine messages are late but have correct stamps. A delay above `settings.most_behind` is skipped.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot is lost.
    """
    sample = base.plant.sample_time
    clock.origin = clock()
    while going():
        now = clock.origin + round(1e9 * base.tick * sample)
        while going() and (left := 1e-9 * (now - clock())) > 0:
            spin(left)
        behind = 1e-9 * (clock() - now)
        if behind > settings.most_behind:
            base.node.get_logger().warning(f"{behind:.2f} s behind real time: this time is skipped")
            clock.origin += round(1e9 * behind)
            now += round(1e9 * behind)
        spin(0.0)
        base.publish_sensors(now, clock.origin)
        base.advance(now)
