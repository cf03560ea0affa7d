"""Controllers, robots and sensors broken on purpose: one class for each fault, and the monitor's task."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray, Measurement, Reference, Stamped
from diffdrive_mpc.mpc.trajectories.moved import starting_at

SAMPLE = 0.0202
"""Time between two commands of the robot of the papers [s]."""
_SLEW = (2.0, 6.0)
"""Within which most of these faults keep: one that jumps is found by that alone [m/s^2, rad/s^2]."""
_FASTEST = (1.45, 1.95)
"""And within which range [m/s, rad/s]."""


class Sent(NamedTuple):
    """A command as it leaves the controller: stamp [s], v [m/s], omega [rad/s]."""

    stamp: float
    v: float
    omega: float


class Fault:
    """Nothing is wrong; subclasses break one thing from `begins` on.

    Parameters
    ----------
    begins
        Time of the fault's start [s].
    """

    def __init__(self, begins: float = math.inf) -> None:
        self.begins = begins
        self._last: Sent | None = None

    def start(self, reference: Reference) -> None:
        """Start a drive along `reference` at time 0."""
        self._end = reference.duration

    def followed(self, reference: Reference) -> Reference:
        """Return the reference that the controller follows instead of the given one."""
        return reference

    def published(self, points: FloatArray) -> FloatArray:
        """Return time, x, y, theta (n, 4) of the reference as published to others."""
        return points

    def measures(self, measurement: Measurement) -> Measurement:
        """Return the measurement of the sensors from `begins` on, for controller and monitor."""
        return measurement

    def sees(self, measurement: Measurement) -> Measurement:
        """Return the measurement as the controller reads it."""
        return measurement

    def sends(self, command: Sent) -> list[Sent]:
        """Return the commands sent at a tick instead of `command`."""
        return [command]

    def says(self, mode: str) -> str:
        """Return the reported mode."""
        return mode

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        """Return the motion of the robot for a command."""
        return command

    def smooth(self, stamp: float, v: float, omega: float) -> list[Sent]:
        """Build a wrong command within range and slew, as after a limiter."""
        before = self._last or Sent(stamp, 0.0, 0.0)
        wanted, sent = (v, omega), []
        for value, old, slew, most in zip(wanted, before[1:], _SLEW, _FASTEST, strict=True):
            step = 0.98 * slew * SAMPLE
            sent.append(min(max(min(max(value, old - step), old + step), -most), most))
        return [Sent(stamp, *sent)]

    def went(self, sent: list[Sent]) -> None:
        """Record the sent commands, sound or not."""
        if sent:
            self._last = sent[-1]

    def active(self, t: float) -> bool:
        """Return True if the fault is active at `t` [s]."""
        return t >= self.begins


class _Late(Fault):
    """Stores the measurements, to return them later."""

    def __init__(self, begins: float, ticks: int) -> None:
        super().__init__(begins)
        self.pending: deque[Sent] = deque(maxlen=ticks + 1)

    def went(self, sent: list[Sent]) -> None:
        """Record nothing, since late commands must not be delayed again."""


class WrongSign(Fault):
    """Turns left where it should turn right."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, -command.omega)


class Backwards(Fault):
    """Drives backwards where it should drive forwards."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, -command.v, command.omega)


class Frozen(Fault):
    """Sends its last command for ever, with fresh stamps."""

    def sends(self, command: Sent) -> list[Sent]:
        return [(self._last or command)._replace(stamp=command.stamp)]


class NotANumber(Fault):
    """Sends values that are no numbers."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(omega=math.nan)]


class Infinite(Fault):
    """Sends infinity."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=math.inf)]


class SlowTicks(Fault):
    """Sends every fifth command only."""

    count = 0

    def sends(self, command: Sent) -> list[Sent]:
        self.count += 1
        return [command] if self.count % 5 == 0 else []


class Races(Fault):
    """Drives as fast as it may."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, _FASTEST[0], command.omega)


class LimitsCreep(Fault):
    """Limits that grow, and are used by the controller."""

    def sends(self, command: Sent) -> list[Sent]:
        v = (self._last or command).v
        return [command._replace(v=v + 0.15 * SAMPLE)]


class TooFast(Fault):
    """Sends three times the speed, at once and beyond all limits."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=3.0 * command.v + 1.0)]


class LateAndStamped(_Late):
    """Its commands are half a second old when they are sent, as their stamp states."""

    def went(self, sent: list[Sent]) -> None:
        self.pending.extend(sent if len(self.pending) < 25 else ())

    def sends(self, command: Sent) -> list[Sent]:
        self.pending.append(command)
        return [self.pending.popleft()]


class LateUnsaid(_Late):
    """Its commands are 0.6 s late, with fresh stamps."""

    def sends(self, command: Sent) -> list[Sent]:
        self.pending.append(command)
        return [self.pending[0]._replace(stamp=command.stamp)]


class Alternates(Fault):
    """Changes sign from command to command."""

    sign = 1.0

    def sends(self, command: Sent) -> list[Sent]:
        self.sign = -self.sign
        return [command._replace(v=self.sign * command.v)]


class Swings(Fault):
    """Steers to the left and to the right as much as it can, half a second each."""

    count = 0

    def sends(self, command: Sent) -> list[Sent]:
        self.count += 1
        return self.smooth(command.stamp, command.v, 1.9 if self.count // 25 % 2 else -1.9)


class NeverStops(Fault):
    """Continues beyond the end of its path."""

    def active(self, t: float) -> bool:
        return t >= self._end - 0.6

    def sends(self, command: Sent) -> list[Sent]:
        last = self._last or command
        return [last._replace(stamp=command.stamp)]

    def says(self, mode: str) -> str:
        return "TRACKING"


class NeverStopsButSaysSo(NeverStops):
    """The same, and reports that it has finished."""

    def says(self, mode: str) -> str:
        return mode


class CreepsAfterEnd(Fault):
    """Sends 0.029 m/s after it has finished, which counts as standing."""

    def active(self, t: float) -> bool:
        return t >= self._end + 1.5

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=0.029)]


class StraightOn(Fault):
    """Ignores its path and drives straight on."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, 0.5, 0.0)


class Spins(Fault):
    """Turns on the spot."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, 0.0, 1.9)


class Drifts(Fault):
    """Its assumed position moves away from the true one by 0.1 m every second."""

    since: float | None = None

    def sees(self, measurement: Measurement) -> Measurement:
        pose = measurement.pose
        if pose is None:
            return measurement
        self.since = pose.time if self.since is None else self.since
        away = 0.1 * (pose.time - self.since)
        value = np.asarray(pose.value, dtype=float) + np.array([away, away, 0.0]) / math.sqrt(2.0)
        return replace(measurement, pose=Stamped(value, pose.time, pose.covariance))


class ScaledOmega(Fault):
    """Commands twelve times the yaw rate that it means: it swings between its limits."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, 12.0 * command.omega)


class NoOmega(Fault):
    """Its yaw rate is lost during transmission."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, 0.0)


class Swapped(Fault):
    """Takes v for omega, and omega for v."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.omega, command.v)


class ReplaysStamped(_Late):
    """Sends the commands of three seconds ago, as they were."""

    def went(self, sent: list[Sent]) -> None:
        self.pending.extend(sent)

    def sends(self, command: Sent) -> list[Sent]:
        return [self.pending[0]]


class Replays(Fault):
    """Sends the commands of three seconds ago, with fresh stamps, and goes over to them smoothly."""

    def __init__(self, begins: float) -> None:
        super().__init__(begins)
        self._kept: deque[Sent] = deque(maxlen=150)

    def went(self, sent: list[Sent]) -> None:
        super().went(sent)
        self._kept.extend(sent)

    def sends(self, command: Sent) -> list[Sent]:
        old = self._kept[0]
        return self.smooth(command.stamp, old.v, old.omega)


class MovesWhilePaused(Fault):
    """Reports that it stands, and drives on."""

    def says(self, mode: str) -> str:
        return "PAUSED"


class Silent(Fault):
    """Sends nothing any more."""

    def sends(self, command: Sent) -> list[Sent]:
        return []


class SeesThePast(Fault):
    """Uses the first sensor readings for ever."""

    last: Measurement | None = None

    def sees(self, measurement: Measurement) -> Measurement:
        if self.last is None or self.last.pose is None:
            self.last = measurement
        names = ("pose", "wheel_twist", "yaw_rate")
        old = {name: getattr(self.last, name) for name in names}
        new = {name: getattr(measurement, name) for name in names}
        fresh = {
            name: None if new[name] is None or old[name] is None else replace(old[name], time=new[name].time)
            for name in names
        }
        return replace(measurement, **fresh)


class WrongFrame(Fault):
    """Follows its path in a frame that is turned by 50 degrees."""

    def followed(self, reference: Reference) -> Reference:
        return starting_at(reference, reference.sample([0.0]).pose[0] + [0.0, 0.0, math.radians(50.0)])


class JumpingReference(Fault):
    """Its reference jumps by a metre."""

    def published(self, points: FloatArray) -> FloatArray:
        jumped = points.copy()
        jumped[len(jumped) // 2 :, 1] += 1.0
        return jumped


class NoReference(Fault):
    """Drives without publishing a reference."""

    def published(self, points: FloatArray) -> FloatArray:
        return points[:0]


class Floods(Fault):
    """Sends every command twenty times."""

    def sends(self, command: Sent) -> list[Sent]:
        return 20 * [command]


class StampedAhead(Fault):
    """Its commands are of a second from now."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(stamp=command.stamp + 1.0)]


class OutOfOrder(Fault):
    """Its commands come in the wrong order, by twos."""

    held: Sent | None = None

    def sends(self, command: Sent) -> list[Sent]:
        if self.held is None:
            self.held = command
            return []
        first, self.held = self.held, None
        return [command, first]


class Shakes(Fault):
    """Adds noise, more than the robot can follow."""

    def __init__(self, begins: float) -> None:
        super().__init__(begins)
        self._noise = np.random.default_rng(1)

    def sends(self, command: Sent) -> list[Sent]:
        v, omega = self._noise.uniform(-0.5, 0.5, 2)
        return [command._replace(v=command.v + v, omega=command.omega + omega)]


class DeafBase(Fault):
    """The robot executes its last command, independent of later ones: stopped, it drives on."""

    held: tuple[float, float] | None = None

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        if self.held is None:
            self.held = command
        return self.held


class Runaway(Fault):
    """The robot drives as fast as it can, independent of its commands."""

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        return 1.5, command[1]


class Miswired(Fault):
    """The robot turns to the other side than commanded."""

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        return command[0], -command[1]


class TurnedGyro(Fault):
    """The gyro has the wrong sign."""

    def measures(self, measurement: Measurement) -> Measurement:
        gyro = measurement.yaw_rate
        return (
            measurement if gyro is None else replace(measurement, yaw_rate=Stamped(-np.asarray(gyro.value), gyro.time))
        )


class FrozenPose(Fault):
    """Poses come and never change."""

    held: Stamped | None = None

    def measures(self, measurement: Measurement) -> Measurement:
        pose = measurement.pose
        if pose is None:
            return measurement
        self.held = pose if self.held is None else self.held
        return replace(measurement, pose=replace(self.held, time=pose.time))


class NoOdometry(Fault):
    """There is no odometry any more."""

    def measures(self, measurement: Measurement) -> Measurement:
        return replace(measurement, wheel_twist=None)


@dataclass(frozen=True)
class FaultBounds:
    """Requirements on the monitor for a fault.

    Attributes
    ----------
    make
        The fault, from when it begins [s].
    stated
        Time after it within which the monitor stops the robot [s].
    part
        Broken part: "controller", or "robot" for robot and sensors.
    stoppable
        Whether the robot can be stopped by commands.
    controller
        Controller of the drive. The MPC finds some faults itself and stops; then one drives that has no checks.
    """

    make: Callable[[float], Fault]
    stated: float
    part: str = "controller"
    stoppable: bool = True
    controller: str = "mpc"


FAULTS: dict[str, FaultBounds] = {
    "not a number": FaultBounds(NotANumber, 0.05),
    "infinite": FaultBounds(Infinite, 0.05),
    "too fast": FaultBounds(TooFast, 0.05),
    "alternates": FaultBounds(Alternates, 2.0),
    "shakes": FaultBounds(Shakes, 0.5),
    "floods": FaultBounds(Floods, 0.1),
    "stamped ahead": FaultBounds(StampedAhead, 0.05),
    "out of order": FaultBounds(OutOfOrder, 0.1),
    "silent": FaultBounds(Silent, 0.3),
    "slow ticks": FaultBounds(SlowTicks, 2.0),
    "late, as stamped": FaultBounds(lambda begins: LateAndStamped(begins, 25), 0.1),
    "replays, as stamped": FaultBounds(lambda begins: ReplaysStamped(begins, 150), 0.05),
    "jumping reference": FaultBounds(JumpingReference, 0.05),
    "no reference": FaultBounds(NoReference, 0.5),
    "moves while paused": FaultBounds(MovesWhilePaused, 2.0),
    "never stops": FaultBounds(NeverStops, 4.0),
    "never stops, and says it has": FaultBounds(NeverStopsButSaysSo, 4.0),
    "creeps after the end": FaultBounds(CreepsAfterEnd, 4.0),
    "spins": FaultBounds(Spins, 2.5),
    "races": FaultBounds(Races, 4.0),
    "limits creep": FaultBounds(LimitsCreep, 6.0),
    "backwards": FaultBounds(Backwards, 2.0),
    "wrong sign": FaultBounds(WrongSign, 8.0),
    "swapped": FaultBounds(Swapped, 4.0),
    "straight on": FaultBounds(StraightOn, 6.0),
    "no omega": FaultBounds(NoOmega, 15.0, controller="kanayama-plain"),
    "frozen": FaultBounds(Frozen, 6.0),
    "swings": FaultBounds(Swings, 6.0),
    "scaled omega": FaultBounds(ScaledOmega, 8.0, controller="kanayama-plain"),
    "late, unsaid": FaultBounds(lambda begins: LateUnsaid(begins, 30), 10.0),
    "replays": FaultBounds(Replays, 10.0),
    "drifts": FaultBounds(Drifts, 10.0, controller="kanayama-plain"),
    "sees the past": FaultBounds(SeesThePast, 4.0, controller="kanayama-plain"),
    "wrong frame": FaultBounds(WrongFrame, 6.0),
    "deaf base": FaultBounds(DeafBase, 4.0, "robot", stoppable=False),
    "runaway": FaultBounds(Runaway, 1.5, "robot", stoppable=False),
    "miswired": FaultBounds(Miswired, 3.0, "robot"),
    "turned gyro": FaultBounds(TurnedGyro, 3.0, "robot"),
    "frozen pose": FaultBounds(FrozenPose, 3.0, "robot", controller="kanayama-plain"),
    "no odometry": FaultBounds(NoOdometry, 0.3, "robot"),
}
"""By name."""
AT_START = frozenset({"jumping reference", "no reference", "wrong frame"})
"""Those that are there from the start."""
