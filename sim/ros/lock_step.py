"""Lock step: sensors of a tick, then /clock, then the command to that tick, then the next tick."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from sim.ros import messages
from sim.ros.base_settings import LockStep
from sim.ros.robot_clock import SteppedClock
from sim.ros.simulated_base import SimulatedBase

Spin = Callable[[float], None]
"""Handles at most one message, waiting for it at most so long [s]."""


def drive_in_lock_step(
    base: SimulatedBase, clock: SteppedClock, settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` says no.

    The clock stands until somebody is connected who publishes commands. From then on every tick waits for its command
    for the answer timeout at most, or as long as a repeat of the clock takes while nobody is connected any more: when a
    controller falls silent or dies the robot goes on, slowly, and the command timeout acts.

    Raises
    ------
    sim.plant.RobotLostError
        If the robot is lost.
    """
    ticker = base.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    if not base.commanded:
        base.node.get_logger().info(f"lock step: waiting for somebody to publish commands on {base.command_topic}")
    while going() and not base.commanded:
        ticker.publish(messages.clock(clock()))
        spin(settings.clock_repeat)
    while going():
        now = clock.at(base.tick)
        base.publish_sensors(now, clock.origin)
        _wait_for_answer(base, now, ticker.publish, settings, spin, going)
        base.advance(now)


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
