"""Faults of controllers, robots and sensors: one class for each fault, and the requirements on the monitor."""

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
"""Sample time of the robot of the papers [s]."""
_SLEW = (2.0, 6.0)
"""Slew limits of most faulty commands [m/s^2, rad/s^2], because a jump would be detected immediately."""
_MAX_COMMAND = (1.45, 1.95)
"""Range of most faulty commands [m/s, rad/s]."""


class Sent(NamedTuple):
    """A command as it leaves the controller: stamp [s], v [m/s], omega [rad/s]."""

    stamp: float
    v: float
    omega: float


class Fault:
    """Base of faults; subclasses add one fault from `start_time` on.

    Parameters
    ----------
    start_time
        Start time of the fault [s].
    """

    def __init__(self, start_time: float = math.inf) -> None:
        self.start_time = start_time
        self._last: Sent | None = None

    def start(self, reference: Reference) -> None:
        """Start a drive along `reference` at time 0."""
        self._end = reference.duration

    def followed(self, reference: Reference) -> Reference:
        """Return the reference that the controller tracks."""
        return reference

    def published(self, points: FloatArray) -> FloatArray:
        """Return the reference (n, 4) as published: time, x, y, theta."""
        return points

    def measures(self, measurement: Measurement) -> Measurement:
        """Return the measurement for controller and monitor."""
        return measurement

    def sees(self, measurement: Measurement) -> Measurement:
        """Return the measurement for the controller."""
        return measurement

    def sends(self, command: Sent) -> list[Sent]:
        """Return the commands that are sent in place of `command`."""
        return [command]

    def says(self, mode: str) -> str:
        """Return the mode that is reported."""
        return mode

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        """Return the command that the robot executes."""
        return command

    def smooth(self, stamp: float, v: float, omega: float) -> list[Sent]:
        """Build a faulty command within range and slew limits."""
        before = self._last or Sent(stamp, 0.0, 0.0)
        target, sent = (v, omega), []
        for value, old, slew, maximum in zip(target, before[1:], _SLEW, _MAX_COMMAND, strict=True):
            step = 0.98 * slew * SAMPLE
            sent.append(min(max(min(max(value, old - step), old + step), -maximum), maximum))
        return [Sent(stamp, *sent)]

    def record(self, sent: list[Sent]) -> None:
        """Record the sent commands."""
        if sent:
            self._last = sent[-1]

    def active(self, t: float) -> bool:
        """Return True if the fault is active at `t` [s]."""
        return t >= self.start_time


class _Delayed(Fault):
    """Base of faults that delay commands."""

    def __init__(self, start_time: float, ticks: int) -> None:
        super().__init__(start_time)
        self.pending: deque[Sent] = deque(maxlen=ticks + 1)

    def record(self, sent: list[Sent]) -> None:
        """Record nothing, because delayed commands must not be delayed again."""


class WrongSign(Fault):
    """The yaw rate has the wrong sign."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, -command.omega)


class Backwards(Fault):
    """The speed has the wrong sign."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, -command.v, command.omega)


class Frozen(Fault):
    """The controller repeats its last command with new stamps."""

    def sends(self, command: Sent) -> list[Sent]:
        return [(self._last or command)._replace(stamp=command.stamp)]


class NotANumber(Fault):
    """The controller sends NaN."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(omega=math.nan)]


class Infinite(Fault):
    """The controller sends infinity."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=math.inf)]


class SlowTicks(Fault):
    """The controller sends only each fifth command."""

    count = 0

    def sends(self, command: Sent) -> list[Sent]:
        self.count += 1
        return [command] if self.count % 5 == 0 else []


class MaxSpeed(Fault):
    """The controller sends the maximum speed."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, _MAX_COMMAND[0], command.omega)


class GrowingSpeed(Fault):
    """The speed grows slowly."""

    def sends(self, command: Sent) -> list[Sent]:
        v = (self._last or command).v
        return [command._replace(v=v + 0.15 * SAMPLE)]


class TooFast(Fault):
    """The controller sends more than three times the speed, without slew limit."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=3.0 * command.v + 1.0)]


class DelayedAndStamped(_Delayed):
    """Commands are sent half a second late with their original stamps."""

    def record(self, sent: list[Sent]) -> None:
        self.pending.extend(sent if len(self.pending) < 25 else ())

    def sends(self, command: Sent) -> list[Sent]:
        self.pending.append(command)
        return [self.pending.popleft()]


class DelayedUnstamped(_Delayed):
    """Commands are sent 0.6 s late with new stamps."""

    def sends(self, command: Sent) -> list[Sent]:
        self.pending.append(command)
        return [self.pending[0]._replace(stamp=command.stamp)]


class Alternates(Fault):
    """The sign of the speed alternates."""

    sign = 1.0

    def sends(self, command: Sent) -> list[Sent]:
        self.sign = -self.sign
        return [command._replace(v=self.sign * command.v)]


class Swings(Fault):
    """The yaw rate alternates between its limits with a period of one second."""

    count = 0

    def sends(self, command: Sent) -> list[Sent]:
        self.count += 1
        return self.smooth(command.stamp, command.v, 1.9 if self.count // 25 % 2 else -1.9)


class NeverStops(Fault):
    """The controller continues after the end of its path."""

    def active(self, t: float) -> bool:
        return t >= self._end - 0.6

    def sends(self, command: Sent) -> list[Sent]:
        last = self._last or command
        return [last._replace(stamp=command.stamp)]

    def says(self, mode: str) -> str:
        return "TRACKING"


class NeverStopsButReportsEnd(NeverStops):
    """The controller continues after the end of its path, and reports that it has finished."""

    def says(self, mode: str) -> str:
        return mode


class CreepsAfterEnd(Fault):
    """The controller sends 0.029 m/s after the end, which counts as standing."""

    def active(self, t: float) -> bool:
        return t >= self._end + 1.5

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(v=0.029)]


class StraightOn(Fault):
    """The controller ignores its path and drives straight."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, 0.5, 0.0)


class Spins(Fault):
    """The controller turns on the spot."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, 0.0, 1.9)


class Drifts(Fault):
    """The measured position drifts by 0.1 m/s."""

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
    """The yaw rate is multiplied by twelve and oscillates between its limits."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, 12.0 * command.omega)


class NoOmega(Fault):
    """The yaw rate is zero."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.v, 0.0)


class Swapped(Fault):
    """Speed and yaw rate are swapped."""

    def sends(self, command: Sent) -> list[Sent]:
        return self.smooth(command.stamp, command.omega, command.v)


class ReplaysStamped(_Delayed):
    """Commands are sent three seconds late with their original stamps."""

    def record(self, sent: list[Sent]) -> None:
        self.pending.extend(sent)

    def sends(self, command: Sent) -> list[Sent]:
        return [self.pending[0]]


class Replays(Fault):
    """Commands are sent three seconds late with new stamps, after a smooth transition."""

    def __init__(self, start_time: float) -> None:
        super().__init__(start_time)
        self._history: deque[Sent] = deque(maxlen=150)

    def record(self, sent: list[Sent]) -> None:
        super().record(sent)
        self._history.extend(sent)

    def sends(self, command: Sent) -> list[Sent]:
        old = self._history[0]
        return self.smooth(command.stamp, old.v, old.omega)


class MovesWhilePaused(Fault):
    """The controller reports a pause and continues to drive."""

    def says(self, mode: str) -> str:
        return "PAUSED"


class Silent(Fault):
    """The controller sends no commands."""

    def sends(self, command: Sent) -> list[Sent]:
        return []


class OutdatedMeasurements(Fault):
    """The controller uses the first sensor readings with new stamps."""

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
    """The reference is rotated by 50 degrees."""

    def followed(self, reference: Reference) -> Reference:
        return starting_at(reference, reference.sample([0.0]).pose[0] + [0.0, 0.0, math.radians(50.0)])


class JumpingReference(Fault):
    """The published reference jumps by one metre."""

    def published(self, points: FloatArray) -> FloatArray:
        shifted = points.copy()
        shifted[len(shifted) // 2 :, 1] += 1.0
        return shifted


class NoReference(Fault):
    """The controller publishes no reference."""

    def published(self, points: FloatArray) -> FloatArray:
        return points[:0]


class Floods(Fault):
    """The controller sends each command twenty times."""

    def sends(self, command: Sent) -> list[Sent]:
        return 20 * [command]


class StampedAhead(Fault):
    """The stamps are one second in the future."""

    def sends(self, command: Sent) -> list[Sent]:
        return [command._replace(stamp=command.stamp + 1.0)]


class OutOfOrder(Fault):
    """Pairs of commands are sent in the wrong order."""

    held: Sent | None = None

    def sends(self, command: Sent) -> list[Sent]:
        if self.held is None:
            self.held = command
            return []
        first, self.held = self.held, None
        return [command, first]


class Shakes(Fault):
    """The commands have more noise than the robot can follow."""

    def __init__(self, start_time: float) -> None:
        super().__init__(start_time)
        self._noise = np.random.default_rng(1)

    def sends(self, command: Sent) -> list[Sent]:
        v, omega = self._noise.uniform(-0.5, 0.5, 2)
        return [command._replace(v=command.v + v, omega=command.omega + omega)]


class UnresponsiveBase(Fault):
    """The robot keeps executing one command and ignores all later ones."""

    held: tuple[float, float] | None = None

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        if self.held is None:
            self.held = command
        return self.held


class Runaway(Fault):
    """The robot drives at its maximum speed, independent of its commands."""

    def obeys(self, command: tuple[float, float]) -> tuple[float, float]:
        return 1.5, command[1]


class Miswired(Fault):
    """The robot turns in the wrong direction."""

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
    """The poses are constant with new stamps."""

    held: Stamped | None = None

    def measures(self, measurement: Measurement) -> Measurement:
        pose = measurement.pose
        if pose is None:
            return measurement
        self.held = pose if self.held is None else self.held
        return replace(measurement, pose=replace(self.held, time=pose.time))


class NoOdometry(Fault):
    """The odometry is lost."""

    def measures(self, measurement: Measurement) -> Measurement:
        return replace(measurement, wheel_twist=None)


@dataclass(frozen=True)
class FaultBounds:
    """Requirements on the monitor for a fault.

    Attributes
    ----------
    make
        Constructor of the fault from its start time [s].
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
    "late, as stamped": FaultBounds(lambda start_time: DelayedAndStamped(start_time, 25), 0.1),
    "replays, as stamped": FaultBounds(lambda start_time: ReplaysStamped(start_time, 150), 0.05),
    "jumping reference": FaultBounds(JumpingReference, 0.05),
    "no reference": FaultBounds(NoReference, 0.5),
    "moves while paused": FaultBounds(MovesWhilePaused, 2.0),
    "never stops": FaultBounds(NeverStops, 4.0),
    "never stops, and says it has": FaultBounds(NeverStopsButReportsEnd, 4.0),
    "creeps after the end": FaultBounds(CreepsAfterEnd, 4.0),
    "spins": FaultBounds(Spins, 2.5),
    "races": FaultBounds(MaxSpeed, 4.0),
    "limits creep": FaultBounds(GrowingSpeed, 6.0),
    "backwards": FaultBounds(Backwards, 2.0),
    "wrong sign": FaultBounds(WrongSign, 8.0),
    "swapped": FaultBounds(Swapped, 4.0),
    "straight on": FaultBounds(StraightOn, 6.0),
    "no omega": FaultBounds(NoOmega, 15.0, controller="kanayama-plain"),
    "frozen": FaultBounds(Frozen, 6.0),
    "swings": FaultBounds(Swings, 6.0),
    "scaled omega": FaultBounds(ScaledOmega, 8.0, controller="kanayama-plain"),
    "late, unsaid": FaultBounds(lambda start_time: DelayedUnstamped(start_time, 30), 10.0),
    "replays": FaultBounds(Replays, 10.0),
    "drifts": FaultBounds(Drifts, 10.0, controller="kanayama-plain"),
    "sees the past": FaultBounds(OutdatedMeasurements, 4.0, controller="kanayama-plain"),
    "wrong frame": FaultBounds(WrongFrame, 6.0),
    "deaf base": FaultBounds(UnresponsiveBase, 4.0, "robot", stoppable=False),
    "runaway": FaultBounds(Runaway, 1.5, "robot", stoppable=False),
    "miswired": FaultBounds(Miswired, 3.0, "robot"),
    "turned gyro": FaultBounds(TurnedGyro, 3.0, "robot"),
    "frozen pose": FaultBounds(FrozenPose, 3.0, "robot", controller="kanayama-plain"),
    "no odometry": FaultBounds(NoOdometry, 0.3, "robot"),
}
"""Faults by name."""
AT_START = frozenset({"jumping reference", "no reference", "wrong frame"})
"""Faults that are active from the start of the drive."""
