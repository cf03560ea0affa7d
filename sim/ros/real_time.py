"""Real time: a sample passes every sample time of the wall clock."""

from __future__ import annotations

from collections.abc import Callable

from diffdrive_mpc.sim.ros.base_settings import RealTime
from diffdrive_mpc.sim.ros.lock_step import Spin
from diffdrive_mpc.sim.ros.robot_clock import WallClock
from diffdrive_mpc.sim.ros.simulated_base import SimulatedBase


def drive_in_real_time(
    base: SimulatedBase, clock: WallClock, settings: RealTime, spin: Spin, going: Callable[[], bool]
) -> None:
    """Drive until `going` says no.

    As the robot's firmware, the plant takes a command at its next sample. Stamps are the instants of the samples: where
    the machine is slow, messages come late, but none is stamped wrong. Beyond `settings.most_behind` time is given up.

    Raises
    ------
    sim.plant.RobotLostError
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
