"""Laps along one reference: what repeats is learned and removed, within bounds, and forgotten where it does harm."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from ideal_robot import IdealRobot, drive

from diffdrive_mpc import Controller, Measurement, load_config, load_model, load_trajectory
from diffdrive_mpc.mpc.config.config_file import replace_values
from diffdrive_mpc.mpc.problem.slip import Slip
from diffdrive_mpc.mpc.rehearsal.rehearsal import corrected
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop
from diffdrive_mpc.mpc.trajectories.limits import TrajectoryLimits
from diffdrive_mpc.mpc.trajectories.moved import starting_at
from diffdrive_mpc.mpc.trajectories.segments import Segment, lay_segments

DT = 0.0202
BEND = lay_segments(
    [Segment(v=0.5, omega=0.0, duration=1.5), Segment(v=0.5, omega=0.6, duration=2.0)],
    TrajectoryLimits.of_robot(),
    name="bend",
)


class Drifting(IdealRobot):
    """Is carried to the left and back at the same times of every lap, by `drift` [m/s] at most: a known error."""

    drift = 0.02

    def moved(self, theta, before, after):
        sideways = self.drift * np.sin(2 * np.pi * self.time / 3.0) * (self.time > 0.5)
        return super().moved(theta, before, after) + self.model.dt * sideways * np.array(
            [-np.sin(theta), np.cos(theta), 0.0]
        )


def controller(**settings):
    values = {"rehearsal.enabled": True, **{f"rehearsal.{key}": value for key, value in settings.items()}}
    return Controller(replace_values(load_config("ssm"), values))


def lap(by, *, seed=0, noise=0.0, slip=None, reference=BEND, robot=Drifting, seconds=None):
    """Drive one lap; returns the true position error (n, 2) [m] against the reference as it was given, and results."""
    plant = robot(load_model("ssm").discretise(DT), reference.sample([0.0]).pose[0], slip=slip, noise=noise, seed=seed)
    results, poses, times = drive(by, plant, reference, reference.duration + DT if seconds is None else seconds)
    return (poses - reference.sample(times).pose)[:, :2], results


def rms(error):
    return np.sqrt(np.mean(np.sum(error**2, axis=1)))


def test_a_known_error_that_repeats_is_removed():
    learning = controller()
    errors = [rms(lap(learning)[0]) for _ in range(5)]
    assert errors[0] > 0.003
    assert errors[-1] < 0.35 * errors[0]


def test_under_noise_it_is_removed_but_for_what_does_not_repeat():
    learning, plain = controller(), Controller(load_config("ssm"))
    learned = np.array([lap(learning, seed=k, noise=1.0)[0] for k in range(6)])
    without = np.array([lap(plain, seed=k, noise=1.0)[0] for k in range(6)])
    other = np.sqrt(np.mean([rms(error - without.mean(axis=0)) ** 2 for error in without]) * 6 / 5)
    # At least half of what can be removed is.
    total = np.mean([rms(error) for error in without])
    assert rms(learned[-1]) < 0.5 * (total + other)


def test_the_first_lap_is_driven_as_without_and_off_is_the_default():
    plain = Controller(load_config("ssm"))
    assert plain.rehearsal is None
    assert np.array_equal(lap(controller(), noise=1.0)[0], lap(plain, noise=1.0)[0])


def test_laps_repeat_bit_for_bit():
    one, two = controller(), controller()
    for seed in range(3):
        assert np.array_equal(lap(one, seed=seed, noise=1.0)[0], lap(two, seed=seed, noise=1.0)[0])
    assert np.array_equal(one.rehearsal.correction, two.rehearsal.correction)


def test_the_correction_keeps_its_bounds_and_begins_at_nothing():
    learning = controller(max_correction=0.002, max_correction_rate=0.01, max_heading_correction=0.004)
    for _ in range(4):
        lap(learning)
    found = learning.rehearsal
    assert np.hypot(*found.correction.T[:2]).max() <= 0.002
    assert np.hypot(*np.gradient(found.correction[:, :2], found.time, axis=0).T).max() <= 0.01 * (1 + 1e-9)
    assert np.abs(found.correction[:, 2]).max() <= 0.004
    assert np.abs(found.correction).max() > 0.001
    assert not found.correction[0, :2].any()


@pytest.mark.parametrize(("forgetting", "least", "most"), [(1.0, 0.0, 0.0), (0.5, 0.1, 0.8)])
def test_forgetting_takes_its_share(forgetting, least, most):
    keeping, forgetful = controller(), controller(forgetting=forgetting)
    for _ in range(3):
        lap(keeping)
        lap(forgetful)
    kept, left = (np.abs(one.rehearsal.correction).max() for one in (keeping, forgetful))
    assert least * kept <= left <= most * kept


class Mirrored(Drifting):
    drift = -0.04


@pytest.mark.parametrize(
    ("laps", "other", "word"),
    [(2, {"slip": Slip(yaw_gain=0.7)}, "another floor"), (3, {"robot": Mirrored}, "forgotten")],
    ids=["another floor", "what makes it worse"],
)
def test_what_no_longer_holds_is_forgotten(laps, other, word):
    learning = controller()
    for _ in range(laps):
        lap(learning)
    assert learning.rehearsal.correction.any()
    lap(learning, **other)
    _, results = lap(learning)
    assert word in results[0].message
    assert not learning.rehearsal.correction.any()


def test_a_lap_that_was_not_driven_to_its_end_teaches_nothing():
    learning = controller()
    for _ in range(2):
        lap(learning)
    lap(learning, seconds=1.0)
    before = learning.rehearsal.correction.copy()
    _, results = lap(learning)
    assert "not driven to its end" in results[0].message
    assert np.array_equal(learning.rehearsal.correction, before)


def test_a_lap_without_poses_teaches_nothing():
    learning = controller()
    learning.start(BEND, 0.0)
    for k in range(5):
        learning.step(k * DT, Measurement())
    learning.start(BEND, 0.0)
    assert learning.rehearsal.laps == 0
    assert "at 0.00 s it was STOPPED" in learning.step(0.0, Measurement()).message


def test_the_same_motion_elsewhere_is_the_same_reference_and_another_one_is_not():
    learning = controller()
    for pose in ((0.0, 0.0, 0.0), (2.0, -1.0, 1.0), (5.0, 3.0, -2.0)):
        lap(learning, reference=starting_at(BEND, pose))
    learning.start(starting_at(BEND, (0.0, 0.0, 3.0)), 0.0)
    assert learning.rehearsal.laps == 3
    learning.start(load_trajectory("circle"), 0.0)
    assert learning.rehearsal.laps == 0
    assert not learning.rehearsal.correction.any()


def test_false_poses_teach_nothing():
    def spoil(k, measurement):
        off = np.array([3.0, -2.0, 0.0]) if k % 40 == 20 else np.array([np.nan] * 3) if k % 40 == 30 else np.zeros(3)
        return replace(measurement, pose=replace(measurement.pose, value=measurement.pose.value + off))

    learning, clean = controller(), controller()
    for by, change in ((learning, spoil), (clean, None)):
        for _ in range(2):
            drive(
                by, IdealRobot(load_model("ssm").discretise(DT), np.zeros(3)), BEND, BEND.duration + DT, change=change
            )
        by.start(BEND, 0.0)
    assert learning.rehearsal.laps == 2
    assert np.abs(learning.rehearsal.correction - clean.rehearsal.correction)[:, :2].max() < 0.003


def test_the_node_takes_each_start_of_the_same_reference_for_a_lap():
    topic = SimpleNamespace(fault=lambda *_: "", age=lambda _: 0.0)
    inbox = SimpleNamespace(now=0.0, odometry=topic, newest_pose=None, look_up_pose=lambda: None)
    settings = SimpleNamespace(
        statistics_window=10, drive_on_activate=True, start_at_robot=True, poses_from="odometry", odom_timeout=1.0,
        blocked_timeout=9.0,
    )  # fmt: skip
    loop = ControlLoop(controller(), settings, inbox, BEND, in_sim_time=True)
    robot, said = IdealRobot(load_model("ssm").discretise(DT), np.zeros(3)), []
    for _ in range(2):
        for _ in range(int(BEND.duration / DT) + 130):
            inbox.now, measurement = robot.time, robot.measure()
            inbox.measurement, inbox.newest_pose = lambda kept=measurement: kept, measurement.pose
            tick = loop.tick()
            said.append(tick.message)
            robot.advance(tick.command)
        loop.start()
    assert any("learned from 1 laps" in message for message in said)


def test_reset_forgets():
    learning = controller()
    lap(learning)
    learning.reset()
    learning.start(BEND, 0.0)
    assert learning.rehearsal.laps == 0


def test_a_corrected_reference_moves_as_its_poses_do():
    time = np.linspace(0.0, BEND.duration, 200)
    correction = 0.01 * np.column_stack([np.sin(time), 1 - np.cos(time), np.zeros_like(time)])
    moved = corrected(BEND, time, correction)
    given = BEND.sample(time)
    offset = moved.sample(time).pose - given.pose
    along = offset[:, 0] * np.cos(given.pose[:, 2]) + offset[:, 1] * np.sin(given.pose[:, 2])
    assert np.allclose(along, correction[:, 0], atol=1e-12)
    assert np.allclose(np.hypot(offset[:, 0], offset[:, 1]), np.hypot(*correction.T[:2]), atol=1e-12)
    fine = np.linspace(0.5, BEND.duration - 0.5, 5000)
    sample = moved.sample(fine)
    rate = np.gradient(sample.pose, fine, axis=0)
    v = rate[:, 0] * np.cos(sample.pose[:, 2]) + rate[:, 1] * np.sin(sample.pose[:, 2])
    assert np.allclose(sample.twist, np.column_stack([v, rate[:, 2]]), atol=2e-3)


def test_without_a_correction_it_is_the_same_reference():
    time = np.arange(0.0, BEND.duration, DT)
    same, given = corrected(BEND, time, np.zeros((len(time), 3))).sample(time), BEND.sample(time)
    assert np.allclose(same.pose, given.pose, atol=1e-12)
    assert np.allclose(same.twist, given.twist, atol=1e-9)
