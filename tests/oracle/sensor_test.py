"""The sensor test once more, plain: the past is a list, and motion a vector.

A hypothesis says which readings tell of the body and which of the wheels, and whether the body follows the wheels. It
leaves the least sum of squared deviations over their variances. A fault is the hypothesis without that sensor.
"""

from __future__ import annotations

import cmath
import math
from bisect import bisect_right
from collections.abc import Sequence
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from diffdrive_mpc.models.interface import FloatArray
from oracle.commands import PastCommands
from oracle.motion import arc, sideways, slid, wrapped

WHEELS, GYRO, POSE = 0, 1, 2
# Sums of motion: where wheels and gyro lead (complex: x + i y), how far wheels, gyro and model go and turn, and how far
# the robot turns to either side.
PLACE, HEADING, DISTANCE, WHEEL_TURN, GYRO_TURN, TURNED, MODEL_DISTANCE, MODEL_TURN = range(8)
KEPT_MOTIONS, KEPT_POSES, DELAYS = 96, 36, 7


class Motion(NamedTuple):
    """The sums (8,) up to an instant."""

    time: float
    sums: FloatArray


class SeenPose(NamedTuple):
    """A pose as complex place and heading, and the motion up to it."""

    motion: Motion
    place: complex
    heading: float


class Window(NamedTuple):
    """What each sensor says of a window: turns [rad], and ways [m] in the direction of the heading halfway."""

    turns: tuple[float, float, float, float]
    ways: tuple[float, float, float]
    """By pose, wheels and model, the latter two with the slip known; turns by pose, gyro, wheels and model."""
    left: float
    heading: float
    wheels_turned: float
    model_turned: float
    turned: float
    chord: float
    late: tuple[float, float] = (0.0, 0.0)


class Hearing:
    """A sensor's newest values, and when they came, came after a pause, and changed."""

    def __init__(self, count: int) -> None:
        self.values, self.heard, self.since, self.changed = [0.0] * count, -math.inf, 0.0, 0.0

    def hear(self, t: float, values: Sequence[float], silence: float) -> None:
        """Take a reading; after a pause it counts as changed."""
        paused = t - self.heard > silence
        self.since = t if paused else self.since
        self.changed = t if paused or list(values) != self.values else self.changed
        self.heard, self.values = t, list(values)

    def repeats(self, t: float, silence: float) -> bool:
        """Whether it comes, and has not changed for a while."""
        return t - self.heard <= silence < t - self.changed


class Gain:
    """Quotient of sums over pairs of turns, the older ones forgotten so that it is never surer than `surest`."""

    def __init__(self, value: float, sure: float, surest: float) -> None:
        self.value, self.sure, self.surest = value, sure, surest

    def learn(self, by: float, turn: float) -> None:
        """Take a pair into the sums."""
        top, bottom = self.value * self.sure + by * turn, self.sure + by * by
        self.value, self.sure = top / bottom, min(bottom, self.surest)


class SensorTest:
    """As `mpc/core/sensor_test.c`, for constants `k` by the names of its YAML file."""

    def __init__(self, k: SimpleNamespace, model, wheel_yaw_ratio: float) -> None:
        self.k, self.model, self.ratio = k, model, wheel_yaw_ratio
        self.state, self.slip = np.zeros(model.order), np.zeros(10)
        self.now = Motion(0.0, np.zeros(8, dtype=complex))
        self.path: list[Motion] = []
        self.poses: list[SeenPose] = []
        self.last: SeenPose | None = None
        self.wheels, self.gyro = Hearing(2), Hearing(1)
        sure, _, surest, _ = k.gains
        self.body_by_wheels, self.body_by_model = Gain(1 / wheel_yaw_ratio, sure, surest), Gain(1.0, sure, surest)
        self.wheels_by_model = Gain(wheel_yaw_ratio, sure, surest)
        self.scatter, self.widest, self.residual, self.residuals = np.zeros(2), np.ones(2), np.zeros(3), 0
        self.misfit, self.delay, self.creeping = np.zeros(DELAYS), 0, False
        self.slipped = self.stood = -math.inf
        self.contradictions, self.since, self.agreed = [0] * 3, [0.0] * 3, [0.0] * 3
        self.accused: set[int] = set()
        self.repeating: set[int] = set()
        self.next_pose, self.same = 0.0, 0
        self.honest: list[float] = []
        self.frozen_since = self.now

    def predict(self, commands: PastCommands) -> None:
        """One sample of a robot that nothing disturbs: trapezoids of the model's twist."""
        before = self.model.C @ self.state
        recent, older = commands.acting(0)[:2]
        self.state = self.model.A @ self.state + self.model.B0 @ recent + self.model.B1 @ older
        mean = 0.5 * (before + self.model.C @ self.state)
        # A motion that is kept does not change.
        self.now = Motion(self.now.time, self.now.sums + np.array([0, 0, 0, 0, 0, 0, *(self.model.dt * mean)]))

    def move(self, t: float, wheels, rate, slip: FloatArray, theta: float) -> None:
        """Dead reckoning with trapezoids of what wheels (2) and gyro (1) read; None: nothing came."""
        k, before = self.k, [*self.wheels.values, *self.gyro.values]
        if wheels is not None:
            self.wheels.hear(t, wheels, k.silence)
        if rate is not None:
            self.gyro.hear(t, [rate], k.silence)
        is_first = not self.path
        dt = 0.0 if is_first else t - self.now.time
        if not is_first and not dt > 0.0:
            return
        self.slip = self.slip + (1.0 if is_first else min(dt / k.memory, 1.0)) * (slip - self.slip)
        v, wheel_rate, gyro_rate = 0.5 * (np.array(before) + [*self.wheels.values, *self.gyro.values])
        is_deaf = t - self.gyro.heard > k.silence or GYRO in self.accused
        turn = dt * (self.body_by_wheels.value * wheel_rate if is_deaf else gyro_rate)
        sums = self.now.sums.copy()
        if dt > 0.0:
            sums[PLACE] += cmath.exp(1j * (sums[HEADING].real - theta)) * self._arc(theta, v, turn / dt, dt)
        moved = [turn, v * dt, wheel_rate * dt, gyro_rate * dt, abs(turn)]
        sums[[HEADING, DISTANCE, WHEEL_TURN, GYRO_TURN, TURNED]] += moved
        self.now = Motion(t, sums)
        reach = k.windows[2] + k.pose_spacing + k.latest + k.stamp_history
        if is_first or t - self.path[-1].time >= reach / (KEPT_MOTIONS - 2):
            self.path = [*self.path, self.now][-KEPT_MOTIONS:]
        if not np.isfinite(sums).all():
            # What was summed up is lost, and what it taught.
            self.now = Motion(t, np.where(np.isfinite(sums), sums, 0.0))
            self.path, self.poses, self.residuals, self.last = [], [], 0, None
            self.slip = np.zeros(10)

    def _arc(self, theta: float, v: float, omega: float, dt: float) -> complex:
        """Where a body with these wheels goes that turns with `omega`, on its floor."""
        _, _, longitudinal, _, side_slip, ahead, turn_left, _, *slide = self.slip
        forward = longitudinal * v + turn_left * omega
        dx, dy, _ = arc(theta, forward, omega, dt, sideways(forward, omega, side_slip, ahead))
        more_x, more_y = slid(theta, omega, dt, slide)
        return complex(dx + more_x, dy + more_y)

    def motion_at(self, time: float) -> Motion | None:
        """Between the instants that are kept, and now; at rest before the first of all."""
        if not self.path:
            return None
        if self.path[0].time > time:
            return Motion(time, self.path[0].sums) if len(self.path) < KEPT_MOTIONS else None
        later = bisect_right(self.path, time, key=lambda motion: motion.time)
        a, b = self.path[later - 1], self.path[later] if later < len(self.path) else self.now
        share = min((time - a.time) / (b.time - a.time), 1.0) if b.time > a.time else 0.0
        return Motion(time, a.sums + share * (b.sums - a.sums))

    def compare(self, begin: Motion, end: Motion, a: SeenPose, b: SeenPose) -> Window:
        """What poses, gyro, wheels and model say of the motion between two instants."""
        sums = end.sums - begin.sums
        reckoned, distance, wheels, gyro, turned, way, model = sums[1:].real
        turn = reckoned + wrapped(b.heading - a.heading - reckoned)
        heading = a.heading + 0.5 * turn
        by_pose = (b.place - a.place) * cmath.exp(-1j * heading)
        by_wheels = sums[PLACE] * cmath.exp(-1j * (begin.sums[HEADING].real + 0.5 * reckoned))
        # A chord is shorter than its arc, the model's by as much as that of the wheels; and both slip alike.
        chord = min(abs(by_wheels.real / distance), 1.0) if distance else 1.0
        turns = (turn, gyro, self.body_by_wheels.value * wheels, self.body_by_model.value * model)
        ways = (by_pose.real, by_wheels.real, by_wheels.real + chord * (way - distance))
        turned = max(turned, abs(gyro), abs(turns[3]))
        return Window(turns, ways, by_pose.imag - by_wheels.imag, heading, wheels, model, turned, chord)

    def seconds(self, delay: int) -> float:
        """Of the delay with this index."""
        return self.k.latest * delay / (DELAYS - 1)

    def compare_late(self, a: SeenPose, b: SeenPose, delay: int) -> Window | None:
        """The same if poses are older than stamped; `late` is what an answer that is late by `answer` makes up for."""
        back = self.seconds(delay)
        begin, end = (self.motion_at(seen.motion.time - back) for seen in (a, b))
        if begin is None or end is None:
            return None
        window = self.compare(begin, end, a, b)
        earlier = [self.motion_at(motion.time - self.k.answer) for motion in (begin, end)]
        if None in earlier:
            return window
        then = end.sums - begin.sums - earlier[1].sums + earlier[0].sums
        way, turn = then.real[[MODEL_DISTANCE, MODEL_TURN]]
        return window._replace(late=(window.chord * way, self.body_by_model.value * turn))

    # Hypotheses.

    def weigh(self, window: Window, heard: set[int], noise: Sequence[float], duration: float):
        """Squared deviations that a fault of each sensor leaves (inf: not heard) and the best honest one; or slip."""
        k, absolute, share = self.k, 0, 1
        (pose, gyro, wheels, model), (place, way, commanded) = window.turns, window.ways
        turned, gone = max(abs(gyro), abs(model)), max(abs(place), abs(commanded))

        def variance(deviation, size):
            return deviation[absolute] ** 2 + (deviation[share] * size) ** 2

        unsure, uneven = (k.gains[3] * turned) ** 2 * k.gains[0], (k.uneven * (window.turned - turned)) ** 2
        follows = variance(k.following, turned) + unsure / self.wheels_by_model.sure + window.late[1] ** 2 + uneven
        apart = variance(k.slip_turning, turned) + unsure / self.body_by_wheels.sure + uneven
        turning = [(POSE, pose, noise[1] ** 2), (WHEELS, wheels, 0.0), (None, model, follows)]
        turning.append((GYRO, gyro, (k.gyro[absolute] * duration) ** 2 + (k.gyro[share] * gyro) ** 2))
        driving = [(POSE, place, noise[0] ** 2), (WHEELS, way, 0.0)]
        driving.append((None, commanded, variance(k.following, gone) + window.late[0] ** 2))
        directions = [(turning, apart), (driving, variance(k.slip_driving, gone))]

        def left(without=(), slips=False):
            total = 0.0
            for readings, link in directions:
                used = [(s, x, v) for s, x, v in readings if s not in without and s in (POSE, None, *heard)]
                sides = [[(x, v) for s, x, v in used if (s in (POSE, GYRO)) == body] for body in (True, False)]
                fitted = [_fit(side) for side in sides]
                total += sum(part[2] for part in fitted)
                if all(sides) and not slips:
                    (a, of_a, _), (b, of_b, _) = fitted
                    total += (a - b) ** 2 / (of_a + of_b + link)
            return total

        usual = left()
        honest = min(usual, left(slips=True) + k.odds[0], left(without=(None,)) + k.odds[1])
        faults = [left(without=(s,)) if s in (POSE, *heard) else math.inf for s in range(3)]
        return faults, honest, honest < usual

    def _drift(self, half: Window, whole: Window, noise: float) -> float:
        """Poses that leave dead reckoning in both halves alike, by more than a floor moves the robot unnoticed."""
        k = self.k
        spread = 0.5 * noise**2 + k.slip_driving[0] ** 2
        spread += (0.5 * k.sliding[0] * whole.ways[1]) ** 2 + (0.5 * k.sliding[1] * whole.turned) ** 2
        first, both = (
            complex(window.ways[0] - window.ways[1], window.left) * cmath.exp(1j * window.heading)
            for window in (half, whole)
        )
        along = (first * both.conjugate()).real / abs(both) if both else 0.0
        less = min(along, abs(both) - along)
        return 2.0 * max(less, 0.0) ** 2 / spread

    # Learning.

    def _learn_scatter(self, stated: FloatArray, window: Window) -> None:
        k = self.k
        off = np.array([window.ways[0] - window.ways[1], window.left, window.turns[0] - window.turns[1]])
        # A second difference of independent errors has 1 + 4 + 1 times their variance.
        squares = (off - self.residual) ** 2 / 6.0
        ratios = [squares[:2].mean() / stated[:2].mean(), squares[2] / stated[2]]
        self.residual, self.residuals = off, min(self.residuals + 1, int(k.scatter[1]))
        if self.residuals > 2:
            most = k.scatter[2] * np.maximum(self.scatter, 1.0)
            share = max(k.scatter[0], 1.0 / self.residuals)
            self.scatter = self.scatter + share * (np.minimum(ratios, most) - self.scatter)

    def _learn(self, a: SeenPose, b: SeenPose, noise: Sequence[float]) -> None:
        k = self.k
        window = None if self.creeping else self.compare_late(a, b, self.delay)
        if window:
            turn, wheels, model = 0.5 * (window.turns[0] + window.turns[1]), window.wheels_turned, window.model_turned
            if abs(turn) >= k.held * abs(wheels):
                self.body_by_wheels.learn(wheels, turn)
                self.body_by_model.learn(model, turn)
            self.wheels_by_model.learn(model, wheels)
        self.misfit = self.misfit.copy()
        for delay in range(DELAYS):
            window = self.compare_late(a, b, delay)
            if window is None:
                break
            pairs = ((window.ways[0], window.ways[1], k.slip_driving), (window.turns[0], window.turns[1], k.gyro))
            self.misfit[delay] *= k.late[1]
            for (pose, other, deviation), spread in zip(pairs, noise, strict=True):
                off = (pose - other) / (deviation[0] + spread + deviation[1] * abs(other))
                self.misfit[delay] += min(off**2, k.scatter[2])
        best = int(np.argmin(self.misfit))
        if self.misfit[best] + k.late[0] < self.misfit[0]:
            self.delay = best
        elif self.misfit[0] + k.late[0] < self.misfit[self.delay]:
            self.delay = 0

    # Judging.

    def doubts(self, t: float) -> set[int]:
        """Sensors that repeat themselves where the commands say something else, unless poses say that it stands."""
        k = self.k
        if t - self.stood <= 2.0 * k.windows[0]:
            return set()
        v, omega = self.model.C @ self.state
        pairs = {
            WHEELS: zip(self.wheels.values, (v, self.wheels_by_model.value * omega), strict=True),
            GYRO: [(self.gyro.values[0], self.body_by_model.value * omega)],
        }
        return {
            sensor
            for sensor, hearing in ((WHEELS, self.wheels), (GYRO, self.gyro))
            if hearing.repeats(t, k.silence)
            and any(abs(a - b) > k.doubtful[0] + k.doubtful[1] * abs(b) for a, b in pairs[sensor])
        }

    def _heard_since(self, time: float) -> set[int]:
        pairs = ((WHEELS, self.wheels), (GYRO, self.gyro))
        return {s for s, h in pairs if h.since <= time and self.now.time - h.heard <= self.k.silence}

    def _is_frozen(self, seen: SeenPose, noise: Sequence[float]) -> bool:
        k = self.k
        repeats = (seen.place, seen.heading) == (self.last.place, self.last.heading)
        self.same = self.same + 1 if repeats else 0
        if not repeats:
            self.frozen_since = seen.motion
        if self.same < int(k.often) - 1:
            return False
        window = self.compare(self.frozen_since, seen.motion, seen, seen)
        ways = np.abs((seen.motion.sums - self.frozen_since.sums).real)
        far, turned = k.frozen[0] + 3.0 * noise[0], k.frozen[1] + 3.0 * noise[1]
        heard = self._heard_since(self.frozen_since.time) - self.accused
        moves = [ways[MODEL_DISTANCE] > far or abs(window.turns[3]) > turned]
        moves.append(WHEELS in heard and (ways[DISTANCE] > far or abs(window.turns[2]) > turned))
        moves.append(GYRO in heard and abs(window.turns[1]) > turned)
        return sum(moves) >= 2

    def _kept_before(self, stamp: float, length: float) -> SeenPose | None:
        old = [seen for seen in self.poses if stamp - seen.motion.time >= length - 1e-9]
        return old[-1] if old and stamp - old[-1].motion.time < 2.0 * length else None

    def _weigh_late(self, a: SeenPose, b: SeenPose, heard: set[int], noise: Sequence[float], window: int):
        """Each hypothesis at its likeliest delay that is not excluded; at a pose at fault all delays have to agree."""
        rest = [i for i in range(DELAYS) if not self.misfit[i] > self.misfit[self.delay] + self.k.scatter[2]]
        compared = [self.compare_late(a, b, delay) for delay in rest]
        results = [self.weigh(c, heard, noise, self.k.windows[window]) for c in compared if c]
        if not results:
            return [math.inf] * 3, 0.0, False
        faults = [(max if sensor == POSE else min)(result[0][sensor] for result in results) for sensor in range(3)]
        _, honest, is_another = min(results, key=lambda result: result[1])
        return faults, honest, is_another

    def evidence(self, seen: SeenPose, noise: Sequence[float]) -> tuple[FloatArray, set[int]]:
        """Evidence (3,) against each sensor, and the sensors that all others confirm."""
        k, stamp, agreeing = self.k, seen.motion.time, set()
        evidence, half = np.zeros(3), None
        self.honest = []
        for number, length in enumerate(k.windows):
            kept = self._kept_before(stamp, length)
            window = self.compare_late(kept, seen, self.delay) if kept else None
            if window is None:
                break
            there = self._heard_since(kept.motion.time - self.seconds(self.delay))
            if number == 1:
                half = window
                continue
            result = self._weigh_late(kept, seen, there - self.accused, noise, number)
            evidence = np.maximum(evidence, result[1] - np.array(result[0]))
            self.honest.append(result[1])
            is_plausible = result[1] < k.plausible
            if number == 2:
                apart = (window.turns[0] - window.turns[1]) ** 2
                self.creeping = apart > noise[1] ** 2 + (k.gyro[0] * length) ** 2
                reckons = there - self.accused == {WHEELS, GYRO} and stamp - self.slipped > k.memory
                if reckons and is_plausible:
                    evidence[POSE] = max(evidence[POSE], self._drift(half, window, noise[0]))
                continue
            self._look_at_motion(window, stamp, noise)
            result_of_all = self.weigh(window, there, noise, length) if self.accused else result
            self.honest.append(result_of_all[1])
            if result_of_all[1] < k.plausible:
                agreeing = (there if self.moves else set()) | {POSE}
            self.slipped = stamp if result[2] else self.slipped
            is_alive = self.now.time - min(self.wheels.changed, self.gyro.changed) <= k.silence
            due = stamp >= self.next_pose and is_plausible
            if not self.accused and is_alive and there == {WHEELS, GYRO} and due:
                self._learn(kept, seen, noise)
        if self.doubts(self.now.time) - self.accused:
            evidence[POSE] = 0.0
        if POSE in self.accused:
            evidence[[WHEELS, GYRO]] = 0.0
        return evidence, agreeing

    def _look_at_motion(self, window: Window, stamp: float, noise: Sequence[float]) -> None:
        """Whether it moves, and whether it stands though it is told to move."""
        (far, turned), gone, went = self.k.frozen, abs(window.ways[0]), abs(window.turns[0])
        self.moves = gone > far or went > turned
        told = abs(window.ways[2]) - gone > far or abs(window.turns[3]) - went > 2.0 * turned
        if told and gone <= far + 2.0 * noise[0] and went <= turned + 2.0 * noise[1]:
            self.stood = stamp

    def decide(self, evidence: FloatArray, agreeing: set[int], stamp: float, passed: float) -> None:
        """Accuse and trust again."""
        k, now = self.k, self.now.time
        repeats = [now - self.wheels.changed > k.silence, now - self.gyro.changed > k.silence, self.same > 0]
        for i in range(3):
            other = max(0.0, *np.delete(evidence, i))
            if evidence[i] > k.enough and evidence[i] > other + k.margin:
                self.since[i] = self.since[i] if self.contradictions[i] else stamp
                self.contradictions[i] += 1
                self.agreed[i], lasting = 0.0, stamp - self.since[i]
                enough = self.contradictions[i] >= int(k.often) and lasting >= k.lasting
                if enough or lasting >= k.windows[0]:
                    if i not in self.accused:
                        self.repeating = self.repeating | {i} if repeats[i] else self.repeating - {i}
                    self.accused = self.accused | {i}
                continue
            self.contradictions[i] = 0
            if i in self.accused and i in agreeing and not repeats[i]:
                self.agreed[i] += passed
            if self.agreed[i] >= k.monitor_trust:
                self.accused, self.agreed[i] = self.accused - {i}, 0.0

    def begin(self, stamp: float, pose: FloatArray, covariance: FloatArray):
        """The pose with the motion up to it, or None; and the noise of a difference of two poses [m, rad]."""
        motion = self.motion_at(stamp)
        x, y, theta = np.diag(covariance) * np.maximum(self.scatter, 1.0)[[0, 0, 1]]
        seen = None if motion is None else SeenPose(motion, complex(pose[0], pose[1]), pose[2])
        return seen, (math.sqrt(x + y), math.sqrt(2.0 * theta))

    def judge(self, stamp: float, pose: FloatArray, covariance: FloatArray) -> set[int]:
        """Compare the motion up to a pose; the sensors that are accused from now on."""
        seen, noise = self.begin(stamp, pose, covariance)
        if seen is None:
            return set()
        k, before, is_frozen = self.k, self.accused, False
        if self.last:
            passed = stamp - self.last.motion.time
            window = self.compare(self.last.motion, seen.motion, self.last, seen)
            is_frozen = self._is_frozen(seen, noise)
            far, turned = (0.5 * k.frozen[i] + 3.0 * noise[i] + k.largest_command[i] * passed for i in range(2))
            leap = math.hypot(window.ways[0] - window.ways[1], window.left)
            if leap > far or abs(window.turns[0] - window.turns[1]) > turned:
                self.poses, self.residuals = [], 0
            elif passed <= 0.25 and self.same == 0:
                self._learn_scatter(np.diag(covariance), window)
            self.decide(*self.evidence(seen, noise), stamp, min(passed, 0.25))
        else:
            self.frozen_since = seen.motion
        if is_frozen:
            self.accused, self.repeating = self.accused | {POSE}, self.repeating | {POSE}
            self.agreed[POSE] = 0.0
        if self.accused - before:
            self.misfit, self.delay = np.zeros(DELAYS), 0
        if not self.poses or stamp >= self.next_pose:
            self.poses = [*self.poses, seen][-KEPT_POSES:]
            self.next_pose = stamp + k.pose_spacing - 1e-6
        self.last = seen
        return self.accused - before

    def widen(self, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The covariance that a pose has by its scatter, and by how much the belief before was too sure, (2,)."""
        least, most = self.k.scatter[3:]
        wide = np.where(self.scatter > least, np.minimum(self.scatter, most), 1.0)
        doubt = np.sqrt(np.maximum(wide / self.widest, 1.0))
        self.widest = np.maximum(wide, self.widest)
        by = np.sqrt(wide)[[0, 0, 1]]
        return covariance * np.outer(by, by), doubt

    def report(self) -> dict[str, object]:
        """What the result says."""
        k, most = self.k, self.k.monitor_turn_ratio
        ratios = [self.wheels_by_model.value / self.ratio, self.body_by_wheels.value * self.ratio]
        is_known = min(self.body_by_wheels.sure, self.wheels_by_model.sure) > k.gains[1]
        return {
            "accused": self.accused,
            "repeating": self.repeating & self.accused,
            "pose_scatter": math.sqrt(self.scatter.max()),
            "pose_delay": self.seconds(self.delay),
            "turn_ratio": ratios,
            "scatters": self.scatter.max() > k.scatter[3],
            "late": self.delay > 0,
            "turns_otherwise": is_known and not all(1 / most < ratio < most for ratio in ratios),
        }


def _fit(readings: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Mean of independent (value, variance), its variance, and the squared deviations that it leaves."""
    if not readings:
        return 0.0, 0.0, 0.0
    (mean, variance), left = readings[0], 0.0
    for value, other in readings[1:]:
        both = variance + other
        left += (mean - value) ** 2 / both
        mean, variance = (mean * other + value * variance) / both, variance * other / both
    return mean, variance, left
