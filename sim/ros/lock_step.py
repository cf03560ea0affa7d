"""Lock step: sensors of a tick, then /clock, then the command to that tick, then the next tick."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from diffdrive_mpc.sim.ros import messages
from diffdrive_mpc.sim.ros.base_settings import LockStep
from diffdrive_mpc.sim.ros.robot_clock import SteppedClock
from diffdrive_mpc.sim.ros.simulated_base import SimulatedBase

Spin = Callable[[float], None]
"""Handles at most one message, waiting for it at most so long [s]."""


def drive_in_lock_step(
    base: SimulatedBase, clock: SteppedClock, settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` says no.

    The clock stands until somebody who publishes commands is connected. From then on every tick waits for its command
    for the answer timeout at most, or as long as a repeat of the clock takes while nobody is connected any more: when a
    controller falls silent or dies the robot goes on, slowly, and the command timeout acts.

    Raises
    ------
    sim.plant.RobotLostError
        If the robot is lost.
    """
    ticker = base.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    # One sample before the first tick, so that a timer that this wakes falls due again on the first tick.
    before = messages.clock(clock.at(-1))
    _wait_for_company(base, lambda: ticker.publish(before), settings, spin, going)
    while going():
        now = clock.at(base.tick)
        base.publish_sensors(now, clock.origin)
        _wait_for_answer(base, now, ticker.publish, settings, spin, going)
        base.advance(now)


def _wait_for_company(
    base: SimulatedBase, publish: Callable[[], None], settings: LockStep, spin: Spin, going: Callable[[], bool]
) -> None:
    """Until commands have a publisher and, though not for longer than an answer may take, odometry has a reader.

    Nothing must have connected for the settling time: the first tick is for all who are about to come.
    """
    if not base.commanded:
        base.node.get_logger().info(f"lock step: waiting for somebody to publish commands on {base.command_topic}")
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
