"""Sensors that contradict each other: detection, false alarms, and the robot's reaction."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from ideal_robot import IdealRobot, drive

from diffdrive_mpc import Controller, Stamped, Trajectory, load_config, load_model, load_trajectory
from diffdrive_mpc.mpc import Mode
from diffdrive_mpc.mpc.config.schema import Wheels
from diffdrive_mpc.mpc.trajectories.moved import MovedReference

DT = 0.0202
FAULT = 150
"""Tick at which a sensor fails: after 3 s, at full speed."""
TRACK = Wheels().encoder_track


class HeldRobot(IdealRobot):
    """Robot whose body is held for 1.2 s from the fault on; its wheels stop or spin."""

    spins = False

    @property
    def is_held(self):
        return FAULT <= self.k < FAULT + 60

    @property
    def twist(self):
        return np.zeros(2) if self.is_held else super().twist

    @property
    def wheels(self):
        return np.zeros(2) if self.is_held and not self.spins else super().wheels


class SpinningRobot(HeldRobot):
    spins = True


class QuietHeldRobot(HeldRobot):
    """Robot that is held for 2.6 s; its encoders then read exactly zero, like real encoders."""

    @property
    def is_held(self):
        return FAULT <= self.k < FAULT + 130

    def measure(self):
        measurement = super().measure()
        if not self.is_held:
            return measurement
        return replace(measurement, wheel_twist=replace(measurement.wheel_twist, value=np.zeros(2)))


class PushedRobot(IdealRobot):
    """Robot that is moved by 0.25 m and turned by 0.2 rad within 0.2 s; gyro and poses measure that."""

    push = 0.0

    @property
    def twist(self):
        return super().twist + [0.0, self.push]

    def advance(self, command):
        self.push = 1.0 if FAULT <= self.k < FAULT + 10 else 0.0
        super().advance(command)
        if self.push:
            self.poses[-1] = self.poses[-1] + [0.015, -0.02, 0.0]


def freeze_sensor(field):
    """Return a change for `drive`: the sensor repeats its value at the fault."""
    values = []

    def change(k, m):
        values[k:] = [getattr(m, field).value]
        return replace(m, **{field: replace(getattr(m, field), value=values[min(k, FAULT - 1)])})

    return change


def corrupt_sensor(field, value):
    """Return a change for `drive`: the sensor reads value(correct reading, seconds since the fault)."""

    def change(k, m):
        if k < FAULT:
            return m
        reading = getattr(m, field)
        return replace(m, **{field: replace(reading, value=value(np.asarray(reading.value), (k - FAULT) * DT))})

    return change


def delay_poses(ticks):
    """Return a change for `drive`: each pose is that of `ticks` before, with the present stamp."""
    past = []

    def change(k, m):
        past[k:] = [m.pose.value]
        return replace(m, pose=Stamped(past[max(0, k - ticks)], m.pose.time))

    return change


def fail_encoder(wheels, _):
    """Return the twist if one of the two left wheels reads zero: the speed of the left side is halved."""
    right, left = wheels[0] + 0.5 * TRACK * wheels[1], wheels[0] - 0.5 * TRACK * wheels[1]
    return np.array([0.5 * (right + 0.5 * left), (right - 0.5 * left) / TRACK])


def run(change=None, trajectory="s", model="ssm", robot=IdealRobot, seconds=9.0, **settings):
    """Return the results and the distance to the path [m] of each tick."""
    straight = trajectory == "straight"
    reference = Trajectory.from_waypoints([[0, 0], [7, 0]], speed=0.5) if straight else load_trajectory(trajectory)
    base = robot(load_model(model).discretise(DT), reference.sample([0.0]).pose[0], noise=1.0, seed=1)
    results, poses, _ = drive(Controller(load_config(model, settings), model), base, reference, seconds, change=change)
    path = reference.sample(np.arange(0.0, reference.duration, 0.01)).pose
    distances = np.hypot(poses[:, None, 0] - path[None, :, 0], poses[:, None, 1] - path[None, :, 1]).min(axis=1)
    return results, distances


def unused_sensors(results):
    return {name for result in results for name in result.unused_sensors}


def detection_time(results, name):
    """Return the time from the fault until the sensor was no longer used [s]."""
    return next(k - FAULT for k, result in enumerate(results) if name in result.unused_sensors) * DT


# Fault, trajectory, faulty sensor, and time limit of detection [s]. Slow faults take longer.
FAULTS = {
    "wheels at zero": (corrupt_sensor("wheel_twist", lambda v, _: 0.0 * v), "s", "wheel speed", 1.0),
    "wheels at zero, straight on": (corrupt_sensor("wheel_twist", lambda v, _: 0.0 * v), "cane", "wheel speed", 1.0),
    "wheels stuck": (freeze_sensor("wheel_twist"), "s", "wheel speed", 1.0),
    "an encoder dead": (corrupt_sensor("wheel_twist", fail_encoder), "s", "wheel speed", 1.5),
    "gyro stuck": (freeze_sensor("yaw_rate"), "s", "yaw rate", 1.0),
    "gyro at zero": (corrupt_sensor("yaw_rate", lambda rate, _: 0.0 * rate), "circle", "yaw rate", 1.0),
}


@pytest.mark.parametrize("model", ["ssm", "sm", "mbm"])
@pytest.mark.parametrize("fault", FAULTS)
def test_sensor_contradicted_by_two_others_is_not_used(fault, model):
    """The robot continues with the remaining sensors."""
    change, trajectory, name, time_limit = FAULTS[fault]
    results, distances = run(change, trajectory, model)
    assert unused_sensors(results) == {name}
    assert 0.0 < detection_time(results, name) < time_limit
    assert any(f"{name} not used" in result.message for result in results)
    assert {result.mode for result in results} == {Mode.TRACKING}
    assert distances.max() < 0.1


@pytest.mark.parametrize("model", ["ssm", "sm", "mbm"])
@pytest.mark.parametrize("trajectory", ["circle", "square", "figure8", "k_turn"])
def test_upside_down_gyro_is_detected_without_rejection_of_poses(trajectory, model):
    """Poses count as faulty only if no delay explains the contradiction with the gyro."""

    def invert_gyro(_, m):
        return replace(m, yaw_rate=replace(m.yaw_rate, value=-m.yaw_rate.value))

    results, distances = run(invert_gyro, trajectory, model)
    assert unused_sensors(results) == {"yaw rate"}
    assert distances.max() < 0.1
    pair = run(invert_gyro, trajectory, model, **{"sensors.yaw_rate.sign": -1}), run(None, trajectory, model)
    np.testing.assert_array_equal(*([result.command for result in results] for results, _ in pair))


POSE_FAULTS = {
    "frozen": (freeze_sensor("pose"), "s", 0.5),
    "frozen, straight on": (freeze_sensor("pose"), "cane", 0.5),
    "drifting": (corrupt_sensor("pose", lambda pose, t: pose + [0.05 * t, 0.05 * t, 0.0]), "straight", 5.0),
    "turning": (corrupt_sensor("pose", lambda pose, t: pose + [0.0, 0.0, 0.3 * t]), "s", 1.0),
}


@pytest.mark.parametrize("model", ["ssm", "sm", "mbm"])
@pytest.mark.parametrize("fault", POSE_FAULTS)
def test_robot_brakes_if_poses_are_faulty(fault, model):
    change, trajectory, time_limit = POSE_FAULTS[fault]
    results, distances = run(change, trajectory, model)
    assert detection_time(results, "pose") < time_limit
    detected = next(k for k, result in enumerate(results) if "pose" in result.unused_sensors)
    assert {result.mode for result in results[detected:]} <= {Mode.BRAKING, Mode.STOPPED}
    assert (results[-1].command == 0.0).all()
    assert distances.max() < 0.3


def test_biased_gyro_is_not_rejected():
    """The bias of the gyro is estimated."""
    results, distances = run(corrupt_sensor("yaw_rate", lambda rate, _: rate + 0.05))
    assert unused_sensors(results) == set()
    assert not any("later than their stamps" in result.message for result in results)
    assert {result.mode for result in results} == {Mode.TRACKING}
    assert distances.max() < 0.1
    assert results[-1].estimate.gyro_bias > 0.02


class SlidingRobot(IdealRobot):
    """Robot that slides down a slope, in the direction of x, by 0.1 m per radian of a turn."""

    def advance(self, command):
        super().advance(command)
        self.poses[-1] = self.poses[-1] + [0.1 * abs(self.twist[1]) * DT, 0.0, 0.0]


@pytest.mark.parametrize("trajectory", ["circle", "square", "s", "cane"])
def test_robot_sliding_down_a_slope_is_not_stopped(trajectory):
    results, _ = run(trajectory=trajectory, robot=SlidingRobot, seconds=12.0)
    assert unused_sensors(results) == set()
    assert {result.mode for result in results} <= {Mode.TRACKING, Mode.FINISHED}


@pytest.mark.parametrize("interval", [1, 5, 10])
def test_command_stays_small_for_a_held_robot_with_quiet_encoders(interval):
    """The zero readings are correct: even rare poses confirm them."""

    def drop_poses(k, m):
        return m if k % interval == 0 else replace(m, pose=None)

    results, _ = run(drop_poses, "straight", robot=QuietHeldRobot, seconds=6.0)
    assert unused_sensors(results) == set()
    last_ticks = results[FAULT + 80 : FAULT + 130]
    assert max(abs(result.command[0]) for result in last_ticks) < 0.75
    assert "blocked for" in last_ticks[-1].message


@pytest.mark.parametrize(("field", "name", "channel"), [("wheel_twist", "wheel speed", 0), ("yaw_rate", "yaw rate", 1)])
def test_zero_readings_affect_the_estimate_for_less_than_200_ms(field, name, channel):
    """Repeated readings are rejected long before the poses reveal the faulty sensor."""
    results, _ = run(corrupt_sensor(field, lambda value, _: 0.0 * value), "circle", seconds=3.6)
    twists = np.array([result.estimate.twist[channel] for result in results[FAULT:]])
    assert (np.abs(twists[:5]) < 0.1).all()
    assert (twists[10:] > 0.3).all()
    assert detection_time(results, name) >= 10 * DT


@pytest.mark.parametrize("robot", [IdealRobot, HeldRobot, SpinningRobot, PushedRobot])
@pytest.mark.parametrize("trajectory", ["circle", "cane", "square"])
def test_disturbed_robot_causes_no_rejection_of_sensors(robot, trajectory):
    results, _ = run(trajectory=trajectory, robot=robot)
    assert unused_sensors(results) == set()


def test_monitor_without_findings_changes_no_command():
    monitored, unmonitored = (run(seconds=5.0, **{"monitor.enabled": enabled})[0] for enabled in (True, False))
    assert all((a.command == b.command).all() for a, b in zip(monitored, unmonitored, strict=True))
    assert {result.message for result in monitored} == {""}


@pytest.mark.parametrize(
    ("name", "field"), [("wheel speed", "wheel_twist"), ("yaw rate", "yaw_rate"), ("pose", "pose")]
)
def test_recovered_sensor_is_used_again(name, field):
    corrupt = freeze_sensor(field) if field == "pose" else corrupt_sensor(field, lambda value, _: 0.0 * value)
    # The fault lasts long enough for the detection and the stop of the robot.
    results, distances = run(lambda k, m: corrupt(k, m) if k < FAULT + 75 else m, "circle")
    assert detection_time(results, name) < 1.0
    assert results[-1].unused_sensors == ()
    assert results[-1].mode is Mode.TRACKING
    recovery = next(k for k in range(FAULT + 75, len(results)) if not results[k].unused_sensors)
    assert 0.9 < (recovery - FAULT - 75) * DT < 2.0
    assert distances.max() < 0.1


@pytest.mark.parametrize(("ticks", "has_gyro"), [(1, True), (3, True), (10, True), (5, False), (10, False)])
@pytest.mark.parametrize("trajectory", ["s", "square", "k_turn"])
def test_poses_later_than_their_stamps_are_reported_within_5_s_and_used(trajectory, ticks, has_gyro):
    delay = delay_poses(ticks)

    def change(k, m):
        return delay(k, m if has_gyro else replace(m, yaw_rate=None))

    results, _ = run(change, trajectory, seconds=7.0)
    assert unused_sensors(results) == set()
    for result in results[round(5.0 / DT) :]:
        reported = re.search(r"poses are about ([0-9.]+) s later than their stamps", result.message)
        assert float(reported[1]) == pytest.approx(ticks * DT, abs=0.011)


class MirroredReference:
    """Reference mirrored left to right."""

    def __init__(self, original):
        self.original, self.name, self.duration = original, original.name, original.duration

    def sample(self, times):
        sample = self.original.sample(times)
        return sample._replace(pose=sample.pose * [1, -1, -1], twist=sample.twist * [1, -1])


def scatter_poses(k, m):
    noise = np.random.default_rng(k).normal(size=3) * [0.03, 0.02, 0.02]
    return replace(m, pose=replace(m.pose, value=np.asarray(m.pose.value) + noise))


SYMMETRIC = {
    "sound": (None, IdealRobot),
    "on a slope": (None, SlidingRobot),
    "pushed": (None, PushedRobot),
    "held": (None, SpinningRobot),
    "an encoder dead": (FAULTS["an encoder dead"][0], IdealRobot),
    "gyro stuck": (FAULTS["gyro stuck"][0], IdealRobot),
    "poses drift": (POSE_FAULTS["drifting"][0], IdealRobot),
    "poses scatter": (scatter_poses, IdealRobot),
}


@pytest.mark.parametrize("fault", SYMMETRIC)
def test_verdicts_are_invariant_under_reflection_and_rotation(fault):
    """Mirrored measurements give mirrored commands; rotated measurements give equal commands. Verdicts are equal.

    The rotation is a right angle, because an outlier increases the covariance along the axes of the poses.
    """
    change, robot = SYMMETRIC[fault]
    reference, motion = load_trajectory("s"), np.array([3.0, -2.0, 0.5 * np.pi])
    base = robot(load_model("sm").discretise(DT), reference.sample([0.0]).pose[0], noise=1.0, seed=1)
    mirror_controller, rotated_controller = Controller(load_config("sm")), Controller(load_config("sm"))
    mirror_controller.start(MirroredReference(reference), 0.0)
    rotated_controller.start(MovedReference(reference, motion), 0.0)
    sign = np.array([1.0, -1.0])
    cosine, sine = np.cos(motion[2]), np.sin(motion[2])

    def compare(k, m):
        m = m if change is None else change(k, m)
        x, y, theta = m.pose.value
        mirrored = replace(m, pose=replace(m.pose, value=np.array([x, -y, -theta])),
                           wheel_twist=replace(m.wheel_twist, value=m.wheel_twist.value * sign),
                           yaw_rate=replace(m.yaw_rate, value=-m.yaw_rate.value))  # fmt: skip
        pose = motion + [cosine * x - sine * y, sine * x + cosine * y, theta]
        rotated = replace(m, pose=replace(m.pose, value=pose))
        steps.append((mirror_controller.step(k * DT, mirrored), rotated_controller.step(k * DT, rotated)))
        return m

    steps = []
    results, _, _ = drive(Controller(load_config("sm")), base, reference, 6.0, change=compare)
    for result, (of_mirrored, of_rotated) in zip(results, steps, strict=True):
        assert of_mirrored.command * sign == pytest.approx(result.command, abs=1e-7)
        assert of_rotated.command == pytest.approx(result.command, abs=1e-7)
        assert result.unused_sensors == of_mirrored.unused_sensors == of_rotated.unused_sensors
        assert result.message == of_mirrored.message == of_rotated.message


@pytest.mark.parametrize(("track", "is_reported"), [(TRACK, False), (0.5 * TRACK, True), (2.0 * TRACK, True)])
def test_wrong_track_is_reported_within_ten_seconds_of_turning(track, is_reported):
    results, _ = run(None, "circle", seconds=10.0, **{"wheels.encoder_track": track})
    assert unused_sensors(results) == set()
    assert ("wrong wheels.track" in results[-1].message) == is_reported


@pytest.mark.parametrize("seed", range(3))
def test_false_reports_of_the_base_keep_the_slew_limit(seed):
    """Slew is relative to the controller's last command, whatever the base reports."""
    rng, limits = np.random.default_rng(seed), load_config("ssm").limits

    def misreport(k, m):
        return replace(m, sent=tuple(rng.uniform(-6.0, 6.0, 2))) if rng.random() < 0.3 else m

    results, _ = run(misreport, seconds=5.0)
    steps = np.abs(np.diff([result.command for result in results], axis=0))
    assert (steps <= np.array([limits.v_slew, limits.omega_slew]) * DT + 1e-12).all()
    assert any("exceeds the command limits" in result.message for result in results)
