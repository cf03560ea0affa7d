"""Timing of the simulated base: clocks, lock step with a controller, and real time.

Lock step: sensors of a tick, then /clock, then the command to that tick, then the next tick.
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
"""Handle at most one message, waiting at most this long [s]."""


class SteppedClock:
    """Time that passes in samples, as published on /clock.

    Attributes
    ----------
    origin
        The plant's time 0 [ns].

    Parameters
    ----------
    first_tick
        Samples on the clock at the plant's time 0.
    sample_time
        [s].
    """

    def __init__(self, first_tick: int, sample_time: float) -> None:
        self._sample = sample_time
        # A whole number of samples: a node's timer, which counts from 0, then falls due on the ticks.
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
    """The system's time at the start, carried on by the steady clock: it never jumps.

    Attributes
    ----------
    origin
        The plant's time 0 [ns]; moves on when lost time is given up.
    """

    def __init__(self) -> None:
        self._offset = time.time_ns() - time.monotonic_ns()
        self.origin = self()

    def __call__(self) -> int:
        """Return the current time [ns]."""
        return time.monotonic_ns() + self._offset


class CommandRhythm:
    """Notices a controller with a longer period than the robot: every command is followed by ticks without one."""

    def __init__(self) -> None:
        self._answered: list[int] = []
        self._reported = False

    def differs(self, tick: int, *, answered: bool) -> bool:
        """Take in whether a tick had a command; whether it shows another period, once."""
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
            f"{1e3 * sample_time:.4g} ms: it waits in vain for each other command; start it with the node's "
            "configuration (--config FILE)"
        )


def drive_in_lock_step(
    base: SimulatedBase, clock: SteppedClock, settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` says no.

    The clock stands until a publisher of commands is connected. From then on every tick waits for its command for the
    answer timeout at most, or as long as a repeat of the clock takes while nobody is connected any more: after a
    controller has stopped or died, the robot continues slowly, and the command timeout acts.

    Raises
    ------
    sim.plants.plant.RobotLostError
        If the robot is lost.
    """
    ticker = base.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    # One sample before the first tick, so that a timer that this wakes falls due again on the first tick.
    before = messages.clock(clock.set_tick(-1))
    _wait_for_company(base, lambda: ticker.publish(before), settings, spin, going)
    rhythm = CommandRhythm()
    while going():
        now = clock.set_tick(base.tick)
        base.publish_sensors(now, clock.origin)
        _wait_for_answer(base, now, ticker.publish, settings, spin, going)
        if rhythm.differs(base.tick, answered=base.inbox.answers(now)):
            base.node.get_logger().warning(rhythm.words(base.plant.sample_time))
        base.advance(now)


def _wait_for_company(
    base: SimulatedBase, publish: Callable[[], None], settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Wait until commands have a publisher and, for a limited time, until odometry has a reader.

    Nothing must have connected for the settling time: all connecting nodes must receive the first tick.
    """
    if not base.commanded:
        base.node.get_logger().info(f"lock step: waiting for a publisher of commands on {base.command_topic}")
    patience: float | None = None
    connected: tuple[int, ...] = ()
    settled = math.inf
    while going():
        moment = time.monotonic()
        if connected != base.connections:
            connected, settled = base.connections, moment + settings.settling_time
        if base.commanded:
            patience = patience or moment + settings.answer_timeout
            if moment >= settled and (base.observed or moment >= patience):
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
    """Drive until `going` says no.

    As the robot's firmware, the plant takes a command at its next sample. Stamps are the instants of the samples: where
    the machine is slow, messages come late, but none is stamped wrong. Beyond `settings.most_behind` time is given up.

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
            base.node.get_logger().warning(f"{behind:.2f} s behind real time: this time is given up")
            clock.origin += round(1e9 * behind)
            now += round(1e9 * behind)
        spin(0.0)
        base.publish_sensors(now, clock.origin)
        base.advance(now)
