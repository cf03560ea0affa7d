"""Every field of the configuration has the effect of its own constant in the core.

Every field has a value that differs from its default and from all other fields, and every field affects the drives:
if two fields were exchanged on the path into the core, controller and oracle would differ.
"""

from dataclasses import replace
from functools import cache
from operator import attrgetter

import numpy as np
import pytest
from failing_solver import CorruptedReference
from ideal_robot import IdealRobot
from side_by_side import ACTIVE_SET, Pair, replace_parts

from diffdrive_mpc import ControllerConfig, Measurement, Stamped, load_config, load_model
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.mpc.problem.margin import MIN_WEIGHTS
from diffdrive_mpc.mpc.problem.slip import CURVED_SLIPS, Slip
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.segments import Segment, time_segments

DT = 0.0202
TICKS = 370
SEEDS = (1, 3)
SENSORS = ("sensors.wheels", "sensors.yaw_rate", "sensors.pose")
GROUPS = ("weights", "limits", "wheels", "estimator", "failure", "reentry", "finish", *SENSORS)
# Ranges of fields for which a multiple of the default has no effect on these drives.
RANGES = {
    "limits.v": (0.55, 0.7),
    "limits.omega": (1.2, 1.5),
    "limits.v_slew": (0.6, 1.2),
    "limits.omega_slew": (2.0, 4.0),
    "limits.v_braking": (0.5, 1.2),
    "limits.omega_braking": (1.5, 4.0),
    "limits.predicted_v": (0.38, 0.5),
    "limits.predicted_omega": (0.6, 0.9),
    "limits.wheel_speed": (0.45, 0.55),
    "limits.corridor": (0.01, 0.03),
    "weights.soft": (2.0, 9.0),
    "estimator.lasting_surprise": (0.1, 0.3),
    "estimator.history": (0.15, 0.25),
    "estimator.side_slip": (0.02, 0.09),
    "estimator.load_shift": (0.02, 0.09),
    "failure.max_reused_ticks": (2, 5),
    "failure.max_pose_age": (0.25, 0.45),
    "failure.max_position_error": (0.6, 0.9),
    "failure.resume_within": (0.1, 0.2),
    "reentry.band": (0.1, 0.2),
    "reentry.blocked_after": (0.2, 0.4),
    "reentry.max_progress": (1.05, 1.4),
    "reentry.effort": (0.6, 0.95),
    "finish.timeout": (0.5, 1.5),
    **{f"{sensor}.{late}": (0.002, 0.03) for sensor in SENSORS for late in ("delay", "lag")},
    "sensors.pose.heading": (0.003, 0.02),
    **{f"{sensor}.scale": (0.9, 1.1) for sensor in SENSORS},
}
# Orders 2, 4 and 8, with a different dead time in each channel.
MODELS = {"ssm": (0.013, 0.027), "sm": (0.055, 0.021), "mbm": (0.0, 0.0606)}
# DAQP drops rows with almost no effect of the commands, such as the corridor at the first steps.
DAQP_ACCURACY = 1e-4
# Slip on a different surface, with a different load.
OTHER_SLIP = Slip(
    v_offset=-0.02, omega_gain=1.03, yaw_gain=1.5, side_slip=0.03, turn_ahead=0.04, turn_left=-0.02,
    load_shift=0.04, slide_x=0.03, slide_y=-0.02,
)  # fmt: skip


def numeric_fields():
    """Yield keys and defaults of all numeric fields in the groups."""
    for group in GROUPS:
        for name, field in type(attrgetter(group)(ControllerConfig())).model_fields.items():
            # The oracle has no curved slip, dead reckoning or signs of sensors: other tests cover them.
            excluded = (*CURVED_SLIPS, "dead_reckoning", "sign", "turn_sign")
            default = dict(zip(("v_increment", "omega_increment"), MIN_WEIGHTS.tolist(), strict=True)).get(
                name, field.default
            )
            if not (default is None or isinstance(default, bool) or name.startswith(excluded)):
                yield f"{group}.{name}", default


def distinct_config(seed):
    """Return a configuration with values that differ from their defaults and from each other."""
    rng, values = np.random.default_rng(seed), {}
    for key, default in numeric_fields():
        low, high = RANGES.get(key, (0.6 * default, 1.7 * default))
        values[key] = int(rng.integers(low, high)) if isinstance(default, int) else float(rng.uniform(low, high))
    assert len(set(values.values())) == len(values)
    assert not [key for key, default in numeric_fields() if values[key] == default]
    return load_config("ssm", ACTIVE_SET | {"horizon": 14} | values)


ROUTE = [(0.45, 0.9, 1.0), (0.0, -1.1, 0.6), (0.5, -0.6, 1.5), (-0.3, 0.2, 0.6), (0.45, 0.0, 1.0)]


def route():
    segments = [Segment(v=v, omega=omega, duration=duration) for v, omega, duration in ROUTE]
    return time_segments(segments, TrajectoryLimits.of_robot(), name="route")


class FaultyRobot:
    """Noisy robot with slip and every fault of measurements at some time."""

    def __init__(self, config, model, seed):
        self.settings, self.rng = config.estimator, np.random.default_rng(seed)
        slip = replace(OTHER_SLIP, v_offset=0.02, longitudinal_gain=0.98, yaw_gain=0.7, side_slip=0.06, turn_left=0.03)
        self.robot = IdealRobot(model.discretise(DT), np.zeros(3), slip=slip, noise=1.0, gyro_bias=0.003, seed=seed)
        self.queue = []

    def is_drawn(self, share):
        return self.rng.uniform() < share

    def stamp(self, time):
        """Return the stamp or, sometimes, an older stamp, which may be older than the history."""
        return time - self.rng.uniform(0, 1.5 * self.settings.history) if self.is_drawn(0.08) else time

    def twist(self, value, max_value, jump):
        """Return the value, sometimes with an outlier near the limits in one entry."""
        value = np.array(value, dtype=float)
        if self.is_drawn(0.12):
            index, size = self.rng.integers(value.size), np.array([jump, max_value])[int(self.is_drawn(0.3))]
            value.reshape(-1)[index] += self.rng.choice([-1, 1]) * self.rng.uniform(0.5, 1.5) * np.ravel(size)[index]
        return value

    def pose(self, k, m):
        s, rng = self.settings, self.rng
        self.queue.append(m.pose)
        if k % 60 > 44:
            # After a gap, a stamp before the last stamp is older than the history as well.
            is_old = k % 60 > 55
            return Stamped(m.pose.value, m.pose.time - rng.uniform(0.7, 1.3) * s.history) if is_old else None
        if 240 <= k < 270 or self.is_drawn(0.25):
            return None
        age = min(int(rng.integers(0, 8)) if self.is_drawn(0.3) else 0, len(self.queue) - 1)
        value, time = self.queue[-1 - age].value, self.queue[-1 - age].time
        if self.is_drawn(0.1):
            value = value + rng.uniform(0.3, 1.7) * s.max_position_jump * np.array([0.6, 0.8, 0.0])
        if self.is_drawn(0.1):
            value = value + [0.0, 0.0, rng.choice([-1, 1]) * rng.uniform(0.3, 1.7) * s.max_heading_jump]
        root = 0.01 * rng.normal(size=(3, 3))
        covariance = root @ root.T + 1e-5 * np.eye(3) if self.is_drawn(0.2) else None
        return Stamped(value, self.stamp(time - 0.4 * DT * self.is_drawn(0.2)), covariance)

    def measure(self, k, sent):
        s, m = self.settings, self.robot.measure()
        wheels = self.twist(
            m.wheel_twist.value, [s.max_wheel_speed, s.max_yaw_rate], [s.max_wheel_speed_jump, s.max_yaw_rate_jump]
        )
        gyro = self.twist(m.yaw_rate.value, s.max_yaw_rate, s.max_yaw_rate_jump)
        twists = (Stamped(wheels, self.stamp(m.wheel_twist.time)), Stamped(gyro, self.stamp(m.yaw_rate.time)))
        return Measurement(self.pose(k, m), *twists, sent=tuple(sent))

    def disturb(self, k):
        """Push the robot, move it far away and back, and change its surface."""
        push = {40: [0.0, 0.06, 0.2], 100: [0.2, 0.1, -0.3], 150: [0.0, 1.0, 0.0], 225: [0.0, -1.0, 0.0]}
        if k in push:
            self.robot.poses[-1] = self.robot.pose + push[k]
        if k == 90:
            self.robot.slip = OTHER_SLIP

    def advance(self, k, command):
        robot, is_stuck = self.robot, 200 <= k < 240
        robot.advance(np.zeros(2) if is_stuck else command)
        if is_stuck:
            robot.state = np.zeros_like(robot.state)
            robot.poses[-1] = robot.poses[-2]


@cache
def drive(name, seed):
    """Return the pair of product and oracle after drives with equal results, the configuration and the model."""
    config, model = distinct_config(seed), load_model(name).with_extra_dead_time(MODELS[name])
    pair, reference = Pair(config, model, accuracy=DAQP_ACCURACY), CorruptedReference(route())
    robot, command = FaultyRobot(config, model, seed), np.zeros(2)
    pair.start(reference, 0.0)
    for k in range(TICKS):
        robot.disturb(k)
        if k in (89, 170, 230, 280):
            pair.resume()
        reference.is_corrupted = k in (20, 21) or 30 <= k < 40 or 66 <= k < 82
        hold = Hold("held", failure=True) if 84 <= k < 88 else None
        command = pair.step(robot.robot.time, robot.measure(k, command), hold).command
        robot.advance(k, command)
    reference.is_corrupted = False
    for delay, offset in ((-0.3, 0.0), (config.finish.timeout - 0.2, 0.06)):
        drive_to_end(pair, model, reference, delay, offset)
    return pair, config, model


def drive_to_end(pair, model, reference, delay, offset):
    """Start `delay` [s] after the end of the reference with a lateral offset `offset` [m]."""
    pair.reset()
    end = reference.sample([reference.duration]).pose[0]
    robot = IdealRobot(model.discretise(DT), end + [-0.03, offset, 0.0], noise=0.5)
    pair.start(reference, -reference.duration - delay)
    command = np.zeros(2)
    for _ in range(70):
        command = pair.step(robot.time, replace_parts(robot.measure(), sent=tuple(command))).command
        robot.advance(command)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("seed", SEEDS)
def test_oracle_agrees_on_drives_that_depend_on_every_field(name, seed):
    pair, _, _ = drive(name, seed)
    modes = [str(result.mode) for result in pair.results]
    assert {"TRACKING", "REUSED_PLAN", "BRAKING", "FINISHED"} <= set(modes)
    assert modes.count("TRACKING") > 150


EVENTS = "blocked for, m from the reference, stopped after a failure, not at rest within, the history reaches back"


@pytest.mark.parametrize("message", [*EVENTS.split(", "), "jumps from"])
def test_drives_contain_every_event(message):
    assert any(message in drive(name, seed)[0].messages for name in MODELS for seed in SEEDS)
