"""Slow reference implementation of the rules of the monitor.

Each call evaluates the complete history. The C code uses ring buffers, filters and running bounds instead.
"""

from __future__ import annotations

import numpy as np


def wrap_angle(angle):
    return np.arctan2(np.sin(angle), np.cos(angle))


class OracleJudge:
    """Oracle of the judge; `stopped` is None or (time of the stop, names of all rules violated at this time)."""

    def __init__(self, rules, now):
        self.rules, self.start, self.now = rules, now, now
        self.path = None
        self.sent, self.commands, self.odometry, self.gyros, self.poses = [], [], [], [], []
        self.report, self.rest_since = None, None
        self.violated, self.stopped, self.bounds = {}, None, {}
        self.events, self.placed, self.free_at = [], (-1, None), now
        self.returning, self.away_at, self.away_for, self.path_at = False, 0.0, 0.0, now

    def judge(self, name, violated, lasting=0.0):
        if not violated:
            self.violated.pop(name, None)
            return
        start = self.violated.setdefault(name, self.now)
        if self.now - start >= lasting - 1e-9:
            if self.stopped is None:
                self.stopped = (self.now, {name})
            elif self.stopped[0] == self.now:
                self.stopped[1].add(name)

    def moves(self, twist):
        r = self.rules.commands
        return abs(twist[0]) > r.standing_v or abs(twist[1]) > r.standing_omega

    def reference(self, now, points):
        self.now = now
        points = np.array(points, dtype=float).reshape(-1, 4)
        is_valid = np.isfinite(points).all()
        if is_valid and len(points) > 1:
            dt, step = np.diff(points[:, 0]), np.hypot(*np.diff(points[:, 1:3], axis=0).T)
            turn = np.abs(wrap_angle(np.diff(points[:, 3])))
            r = self.rules.commands
            is_valid = (dt > 0).all() and (step <= r.v * dt + 1e-9).all() and (turn <= r.omega * dt + 1e-9).all()
        self.path = points if is_valid and len(points) else None
        self.returning, self.away_at = True, now - self.rules.path.lasting
        self.judge("bad_reference", not is_valid)

    def is_usable(self, stamp, values, history):
        is_new = not history or stamp > history[-1][0]
        return np.isfinite([stamp, *values]).all() and stamp <= self.now + self.rules.sensors.ahead and is_new

    def says(self, now, *, drives):
        self.now = now
        if self.report is not None and drives and not self.report[1]:
            self.returning, self.away_at = True, now
        if self.report is None or self.report[1] != drives:
            self.rest_since = None if drives else now if self.report is not None else self.rest_since
            self.report = (now, drives)

    def gyro(self, now, stamp, rate):
        self.now = now
        if self.is_usable(stamp, [rate], self.gyros):
            self.gyros.append((stamp, rate))

    def odometry_(self, now, stamp, twist, pose):
        self.now = now
        if not self.is_usable(stamp, [*twist, *pose], self.odometry):
            return
        gyro = self.gyros[-1][1] if self.gyros and self.rules.sensors.gyro_age > 0 else None
        turning = twist[1] if gyro is None else gyro
        self.odometry.append((stamp, *twist, *pose, turning, now, gyro))
        self.events.append(("odometry", self.odometry[-1]))
        standing = self.rules.commands.standing_v
        if not self.sent or abs(self.sent[-1][1][0]) <= standing or abs(twist[0]) > standing:
            self.free_at = now
        self._check_response()
        self._compare_gyro()
        self._rest()

    def _check_response(self):
        """Compare the response with the range of pending commands and decayed earlier bounds."""
        r, now = self.rules.answer, self.now
        row = self.odometry[-1]
        ends = [t for t, _ in self.sent[1:]] + [np.inf]
        pending = [u for (_, u), end in zip(self.sent, ends, strict=False) if end >= now - r.dead_time]
        for i, (name, result, lag, gain, margin) in enumerate(
            [
                ("answer_v", row[1], r.lag_v, r.gain_v, r.margin_v),
                ("answer_omega", row[6], r.lag_omega, r.gain_omega, r.margin_omega),
            ]
        ):
            maximum = gain * max([0.0, *(u[i] for u in pending)])
            minimum = gain * min([0.0, *(u[i] for u in pending)])
            last_time, high, low = self.bounds.get(name, (self.start, 0.0, 0.0))
            weight = (now - last_time) / (lag + now - last_time)
            high = maximum if maximum > high else high + weight * (maximum - high)
            low = minimum if minimum < low else low + weight * (minimum - low)
            self.bounds[name] = (now, high, low)
            self.judge(name, not low - margin <= result <= high + margin, r.lasting)

    def _rest(self):
        """Check the motion of the wheels after the time at which the robot must be at rest."""
        r, response = self.rules.commands, self.rules.answer
        drift = np.zeros(2)
        if self.rest_since is not None:
            motion_times = [t for t, twist in self.sent if self.moves(twist)]
            motion_end = min(motion_times[-1] if motion_times else -np.inf, self.rest_since + r.stop_within)
            rest_at = motion_end + response.dead_time + 3 * max(response.lag_v, response.lag_omega)
            for previous, row in zip(self.odometry, self.odometry[1:], strict=False):
                if row[7] > max(rest_at, self.rest_since):
                    drift += min(row[0] - previous[0], 1.0) * np.array(row[1:3])
        self.judge("creeps", abs(drift[0]) > r.rest_distance)
        self.judge("turns_at_rest", abs(drift[1]) > r.rest_turn)

    def _compare_gyro(self):
        r = self.rules.agreement
        if self.odometry[-1][8] is None:
            return
        wheels = gyro = 0.0
        for k, row in enumerate(self.odometry):
            if row[8] is not None:
                dt = row[0] - self.odometry[k - 1][0] if k else 0.0
                wheels += dt / (r.window + dt) * (row[2] - wheels)
                gyro += dt / (r.window + dt) * (row[8] - gyro)
        bounds = [0.0 + r.window * wheels * ratio for ratio in (r.gyro_gain, r.gyro_least)]
        agrees = min(bounds) - r.gyro_turn <= r.window * gyro <= max(bounds) + r.gyro_turn
        self.judge("gyro_wheels", not agrees, r.lasting)

    def pose(self, now, stamp, pose):
        self.now = now
        if not self.rules.sensors.pose_age > 0 or not self.is_usable(stamp, pose, self.poses):
            return
        self.poses.append((stamp, *pose))
        self.events.append(("pose", self.poses[-1]))
        self._compare_poses()

    def integrated(self, times):
        """Integrate x, y, theta and distance (k, 4) by wheels and gyro up to `times`; NaN for unknown times."""
        t = np.array([row[0] for row in self.odometry])
        if not len(t):
            return np.full((len(times), 4), np.nan)
        dt = np.diff(t, prepend=t[0])
        v, turning = np.array([[row[1], row[6]] for row in self.odometry]).T
        theta = np.cumsum(turning * dt)
        middle = theta - 0.5 * turning * dt
        sums = np.cumsum([v * np.cos(middle) * dt, v * np.sin(middle) * dt, turning * dt, np.abs(v) * dt], axis=1)
        result = np.array([np.interp(times, t, row) for row in sums]).T
        result[np.asarray(times) < t[0] - 1e-9] = np.nan
        return result

    def _place(self):
        """Return the estimated pose and the recent corrections by poses, cached until the next message."""
        if len(self.events) != self.placed[0]:
            self.placed = (len(self.events), self._compute_place())
        return self.placed[1]

    def _compute_place(self):
        r = self.rules.agreement
        pose, unexplained, self.driven, self.pending = None, np.zeros(3), 0.0, np.zeros(3)
        if not self.rules.sensors.pose_age > 0:
            return (np.array(self.odometry[-1][3:6]) if self.odometry else None), unexplained
        motion = self.integrated([event[1][0] for event in self.events])
        newest = None
        for k, (name, row) in enumerate(self.events):
            if name == "odometry":
                dt = min(row[0] - newest[0], 1.0) if newest is not None else 0.0
                unexplained = unexplained * (1.0 - dt / (r.window + dt))
                self.driven += abs(row[1]) * dt - dt / (r.window + dt) * self.driven
                if pose is not None:
                    middle = pose[2] + 0.5 * row[6] * dt
                    pose = pose + dt * np.array([row[1] * np.cos(middle), row[1] * np.sin(middle), row[6]])
                newest = row
                continue
            current = np.array(row[1:4])
            latest = self.integrated([newest[0]])[0] if newest is not None else None
            if latest is not None and row[0] >= self.odometry[0][0] - 1e-9:
                prev = motion[k]
                displacement = (latest[0] - prev[0] + 1j * (latest[1] - prev[1])) * np.exp(1j * (row[3] - prev[2]))
                current = current + [displacement.real, displacement.imag, latest[2] - prev[2]]
            pose_times = [event[1][0] for event in self.events[:k] if event[0] == "pose"]
            dt = min(row[0] - pose_times[-1], 1.0) if pose_times else 0.0
            pose = current.copy() if pose is None else pose
            error = current - pose
            error[2] = wrap_angle(error[2])
            self.pending = unexplained + error
            pose = pose + dt / (r.blend + dt) * error
            unexplained = unexplained + dt / (r.blend + dt) * error
        return pose, unexplained

    def _compare_poses(self):
        r = self.rules.agreement
        self._place()
        self.judge("pose_jumps", np.hypot(*self.pending[:2]) > r.distance + r.distance_share * self.driven, r.lasting)
        self.judge("pose_turns", abs(self.pending[2]) > r.turn, r.lasting)

    def command(self, now, stamp, v, omega):
        self.now = now
        r = self.rules.commands
        twist = (v, omega)
        self.judge("not_finite", not np.isfinite(twist).all())
        if np.isfinite(twist).all():
            self.judge("speed", abs(v) > (r.v_reverse or r.v if v < 0 else r.v) * (1 + 1e-9))
            self.judge("yaw_rate", abs(omega) > (r.omega_right or r.omega if omega < 0 else r.omega) * (1 + 1e-9))
            is_moving = self.moves(twist)
            ahead = stamp - now
            self.judge("old_command", is_moving and stamp and -ahead > r.oldest)
            self.judge("command_ahead", is_moving and stamp and ahead > self.rules.sensors.ahead)
            stamps = [command[1] for command in self.commands if command[1]]
            self.judge("command_order", is_moving and stamp and stamps and stamp < stamps[-1])
            self.commands.append((now, stamp, v, omega, bool(self.sent) and self.moves(self.sent[-1][1])))
            self._slew()
            self._check_interval(is_moving)
        if self.stopped is None:
            self.sent.append((now, twist))
            self._time()

    def _slew(self):
        r = self.rules.commands
        limits = ((r.v_slew, r.v_braking), (r.omega_slew, r.omega_braking))
        for i, name in enumerate(("slew", "yaw_slew")):
            follower, deviation, violated = 0.0, 0.0, False
            for k, command in enumerate(self.commands):
                if command[2] == 0.0 and command[3] == 0.0:
                    follower, violated = 0.0, False
                    continue
                step = 0.0
                if k:
                    last = next((earlier[1] for earlier in self.commands[k - 1 :: -1] if earlier[1]), None)
                    step = (
                        command[1] - last if command[1] and last is not None else command[0] - self.commands[k - 1][0]
                    )
                step = min(max(step, 0.0), 1.0)
                u = command[2 + i]
                slower = u * follower >= 0 and abs(u) < abs(follower)
                slew = max(limits[i]) if slower else limits[i][0]
                follower = float(np.clip(u, follower - slew * step, follower + slew * step))
                deviation = abs(u - follower)
                violated = deviation > slew * r.jitter
            self.judge(name, violated)

    def _check_interval(self, moving):
        r = self.rules.commands
        middle = 0.5 * (r.slowest + r.quickest)
        mean = middle
        for prior, command in zip([None, *self.commands], self.commands, strict=False):
            mean = mean + 0.05 * (min(command[0] - prior[0], 1.0) - mean) if prior and command[4] else middle
        self.judge("slow", moving and mean > r.slowest)
        self.judge("flood", mean < r.quickest)

    def tick(self, now):
        self.now = now
        if self.stopped is None:
            self._time()

    def _time(self):
        r, now = self.rules, self.now
        output = self.sent[-1][1] if self.sent else (0.0, 0.0)
        is_moving = self.moves(output)
        self.judge("silent", is_moving and now - self.commands[-1][0] > r.commands.silence)
        is_late = self.report is not None and not self.report[1] and now - self.report[0] > r.commands.stop_within
        self.judge("not_to_move", is_moving and is_late, r.path.grace)
        for name, readings, max_age in (
            ("odometry", self.odometry, r.sensors.odometry_age),
            ("pose", self.poses, r.sensors.pose_age),
            ("gyro", self.gyros, r.sensors.gyro_age),
        ):
            age = now - (readings[-1][0] if readings else self.start)
            self.judge(name, is_moving and max_age > 0 and age > max_age)
        self._path(output, is_moving)

    def section(self, start, end):
        """Return poses (n, 3) of the reference at two times and at all its times in between."""
        path = self.path
        start, end = min(start, path[-1, 0]), max(end, path[0, 0])
        inside = path[(path[:, 0] > start) & (path[:, 0] < end), 0]
        times = np.concatenate([[max(start, path[0, 0])], inside, [min(end, path[-1, 0])]])
        headings = np.unwrap(path[:, 3])
        return np.column_stack([np.interp(times, path[:, 0], column) for column in (path[:, 1], path[:, 2], headings)])

    def away(self, pose, start, end, close):
        """Compute the distance from a path section, and the minimum angle to the headings of its near parts."""
        rows = self.section(start, end)
        a, b = (rows[:-1], rows[1:]) if len(rows) > 1 else (rows, rows)
        along = b[:, :2] - a[:, :2]
        length = (along**2).sum(axis=1)
        fraction = np.clip(((pose[:2] - a[:, :2]) * along).sum(axis=1) / np.where(length > 0, length, 1), 0, 1)
        distance = np.linalg.norm(pose[:2] - a[:, :2] - fraction[:, None] * along, axis=1)
        angle = np.abs(wrap_angle(pose[2] - 0.5 * (a[:, 2] + b[:, 2]))) - 0.5 * np.abs(b[:, 2] - a[:, 2])
        is_near = distance <= close
        return distance.min(), max(angle[is_near].min(), 0.0) if is_near.any() else 0.0

    def _path(self, output, moves):
        r, back, now = self.rules.path, self.rules.returning, self.now
        self.judge("no_reference", moves and self.path is None, r.grace)
        pose, unexplained = self._place()
        bound = self.path is not None and pose is not None and (moves or (self.report is not None and self.report[1]))
        is_off_section = is_far = heading = False
        if bound:
            distance, heading_error = self.away(pose, now - r.late, now + r.early, r.distance)
            unexplained = np.hypot(*unexplained[:2])
            is_blocked = now - self.free_at > self.rules.answer.dead_time + self.rules.answer.lasting
            if distance > r.distance:
                self.away_at = now
                if is_blocked or unexplained > r.distance:
                    self.returning = True
            step = min(now - self.path_at, 1.0)
            if distance <= r.distance:
                self.away_for = max(self.away_for - step, 0.0)
            elif self.away_for <= back.within:
                self.away_for += step
            if now - self.away_at >= r.lasting or self.away_for > back.within:
                self.returning = False
            v = self.odometry[-1][1] if self.odometry else 0.0
            v = output[0] if abs(output[0]) > abs(v) else v
            time = r.reaction + abs(v) / (2 * self.rules.commands.v_braking)
            gyro = self.gyros[-1][1] if self.gyros and self.rules.sensors.gyro_age > 0 else None
            rate = gyro if gyro is not None else self.odometry[-1][2] if self.odometry else 0.0
            middle = pose[2] + 0.5 * rate * time
            predicted = pose + time * np.array([v * np.cos(middle), v * np.sin(middle), rate])
            late, early = (back.late, back.early) if self.returning else (r.late, r.early)
            stop_distance, _ = self.away(predicted, now - late, now + time + early, np.inf)
            is_far = stop_distance > (back.distance if self.returning else r.far + unexplained)
            is_off_section, heading = (
                (distance > r.distance, heading_error > r.heading) if not self.returning else (False, False)
            )
        self.path_at = now
        self.judge("strays", is_off_section, r.lasting)
        self.judge("off_path", is_far, r.far_lasting)
        self.judge("off_heading", heading, r.far_lasting)
