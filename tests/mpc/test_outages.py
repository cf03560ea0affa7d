"""Outages of the base, after which the robot may be at another position: after a long outage it waits for `start`.

Loop and inbox of the node run without DDS in simulated time, so that long outages take little time.
"""

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry

from diffdrive_mpc import Controller, load_config, load_trajectory, make_plant
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, RefusedError
from diffdrive_mpc.mpc.ros.conversions import pose_message, time_message
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.step_result import Mode

CONFIG = load_config("ssm")
DT = CONFIG.sample_time


class Rig:
    """Loop, inbox, and a base that can be switched off and displaced."""

    def __init__(self, trajectory="circle", overrides=None, **settings):
        self.tick_number, self.on, self.frame_offset, self.delay = 0, True, np.zeros(3), 0.0
        self.settings = NodeSettings(start_at_robot=False, use_imu=False, **settings)
        self.controller = Controller(load_config("ssm", overrides or {}))
        self.inbox = Inbox(self.settings, lambda: self.now, 0)
        self.plant = make_plant("model:ssm+0.005", surface="ideal", sensors="perfect")
        self.plant.reset((0.0, 0.0, 0.0))
        reference = load_trajectory(trajectory, self.controller.config)
        self.loop = ControlLoop(self.controller, self.settings, self.inbox, reference, in_sim_time=True)
        self.commands = []

    @property
    def now(self):
        return round(1e9 * DT * self.tick_number)

    def pose(self):
        """Return the reported pose: the pose of the plant in the frame after the last displacement."""
        (x, y, angle), plant = self.frame_offset, np.asarray(self.plant.true_pose)
        c, s = math.cos(angle), math.sin(angle)
        return np.array([x + c * plant[0] - s * plant[1], y + s * plant[0] + c * plant[1], plant[2] + angle])

    def carry(self, displacement):
        """Move the robot by `displacement` (3,) [m, m, rad]."""
        target, plant = self.pose() + displacement, np.asarray(self.plant.true_pose)
        angle = target[2] - plant[2]
        c, s = math.cos(angle), math.sin(angle)
        shift = target[:2] - [c * plant[0] - s * plant[1], s * plant[0] + c * plant[1]]
        self.frame_offset = np.array([*shift, angle])

    def tick(self):
        """Run one tick: sensors, command, motion."""
        self.tick_number += 1
        measurement = self.plant.measure()
        message = Odometry(child_frame_id="base_link")
        message.header.stamp = time_message(max(0, self.now - round(1e9 * self.delay)))
        message.header.frame_id = "odom"
        message.pose.pose = pose_message(self.pose())
        message.twist.twist.linear.x, message.twist.twist.angular.z = map(float, measurement.wheel_twist.value)
        if self.on:
            self.inbox.receive_odometry(message)
        if self.settings.poses_from == "topic":
            pose = PoseWithCovarianceStamped()
            pose.header.stamp, pose.header.frame_id = time_message(self.now), "map"
            pose.pose.pose = message.pose.pose
            self.inbox.receive_pose(pose)
        result = self.loop.tick()
        # A base that is switched off coasts to rest.
        self.plant.advance(result.command if self.on else (0.0, 0.0))
        self.commands.append(result.command)
        return result

    def run(self, seconds):
        """Run for `seconds` [s]; return the commands (n, 2)."""
        return np.array([self.tick().command for _ in range(round(seconds / DT))])

    def start_drive(self, seconds=2.0):
        """Drive along the reference for `seconds` [s]."""
        self.run(3 * DT)
        self.loop.start()
        return self.run(seconds)


def random_displacement(random):
    """Return a displacement (3,) between zero and several metres, with any heading."""
    r, angle = random.choice([0.0, 0.3, 1.0, 4.0]) * random.uniform(0.5, 1.5), random.uniform(-math.pi, math.pi)
    return np.array([r * math.cos(angle), r * math.sin(angle), random.uniform(-math.pi, math.pi) * (r > 0)])


def drive_with_outage(seed, **settings):
    """Switch the base off for 2 to 600 s and displace the robot; return the rig and the commands after the outage."""
    random = np.random.default_rng(seed)
    rig = Rig(random.choice(["circle", "square", "s", "cane"]), **settings)
    rig.start_drive(random.uniform(0.5, 4.0))
    rig.on = False
    outage = math.exp(random.uniform(math.log(2.0), math.log(600.0)))
    rig.run(outage / 2)
    rig.carry(random_displacement(random))
    rig.run(outage / 2)
    rig.on = True
    return rig, rig.run(5.0)


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("pose_source", ["odometry", "topic"])
def test_robot_stays_at_rest_after_a_long_outage_until_start(seed, pose_source):
    rig, commands = drive_with_outage(seed, pose_source=pose_source)
    assert not commands.any()
    assert rig.loop.last.mode == Mode.STOPPED
    assert "stopped after a failure (odometry is " in rig.loop.last.message
    assert rig.loop.last.message.endswith("; call start or resume to drive on")
    rig.loop.start()
    rig.run(1.0)
    assert np.abs(rig.commands[-1]).max() > 0.05 or "m from the reference" in rig.loop.last.message


@pytest.mark.long
def test_robot_stays_at_rest_after_many_outages():
    for seed in range(100):
        _, commands = drive_with_outage(7000 + seed)
        assert not commands.any(), seed


@pytest.mark.parametrize("outage", np.linspace(0.1, 0.9, 9).round(1))
def test_robot_continues_after_a_short_outage(outage):
    rig = Rig()
    rig.start_drive()
    rig.on = False
    rig.run(outage)
    rig.on = True
    assert rig.run(2.0)[-1, 0] > 0.2
    assert rig.loop.last.mode == Mode.TRACKING
    assert rig.loop.last.message in ("", "the reference is late and catches up")


def test_old_stamps_count_as_an_outage():
    rig = Rig()
    rig.run(40.0)
    rig.start_drive()
    rig.delay = 30.0
    rig.run(3.0)
    rig.delay = 0.0
    assert not rig.run(3.0).any()


@pytest.mark.parametrize(("jump", "waits"), [(0.7, False), (1.5, True), (-1.5, True)])
def test_clock_jump_counts_as_an_outage_of_the_same_length(jump, waits):
    rig = Rig()
    rig.start_drive()
    rig.tick_number += round(jump / DT)
    rig.run(1.0)
    assert rig.controller.is_latched is waits
    assert rig.commands[-1].any() is np.bool_(not waits)


def test_outage_during_a_hold_requires_a_start():
    rig = Rig()
    rig.start_drive()
    rig.loop.hold(on=True)
    rig.run(1.0)
    rig.on = False
    rig.run(3.0)
    rig.on = True
    rig.run(0.5)
    assert rig.loop.hold(on=False) == "released; stands after a failure; call start or resume to drive"
    assert not rig.run(2.0).any()


def test_resume_returns_to_the_waiting_reference():
    rig = Rig("s")
    rig.start_drive(4.0)
    last_target = rig.loop.last.result.reference[0]
    rig.on = False
    rig.run(1.0)
    # The robot is moved back by less than max_position_error, without progress: it drives this part of the path again.
    rig.carry(np.array([-0.5, 0.0, 0.0]))
    rig.run(20.0)
    rig.on = True
    assert not rig.run(1.0).any()
    assert rig.loop.resume() == "resumed"
    first = rig.tick().result
    assert first.reference_delay > 20.0
    rig.run(5.0)
    assert rig.loop.last.mode == Mode.TRACKING
    sample = rig.loop.reference.sample([rig.now * 1e-9 - rig.loop.drive.t0 - rig.loop.last.result.reference_delay])
    assert np.hypot(*(rig.pose() - sample.pose[0])[:2]) < 0.05
    assert np.hypot(*(sample.pose[0] - last_target)[:2]) > 0.5


def test_resume_far_from_the_waiting_reference_keeps_the_robot_stopped():
    rig = Rig()
    rig.start_drive(3.0)
    rig.on = False
    rig.run(2.0)
    # The robot is moved to the opposite side of the circle: on the path, but without progress.
    x, y, theta = rig.pose()
    opposite = np.array([-x, 2.0 - y, theta + math.pi])
    rig.carry(opposite - rig.pose())
    rig.run(5.0)
    rig.on = True
    rig.run(1.0)
    rig.loop.resume()
    assert not rig.run(3.0).any()
    assert "m from the reference; the limit is 1.0 m" in rig.loop.last.message
    assert rig.loop.start().startswith("starts")


def test_robot_waits_only_after_a_jump_beyond_max_position_error():
    for distance, waits in ((0.6, False), (4.2, True)):
        rig = Rig()
        rig.start_drive(3.0)
        rig.carry(np.array([0.0, distance, 0.0]))
        rig.run(8.0)
        assert rig.controller.is_latched is waits
        assert rig.commands[-1].any() is not np.bool_(waits)


def test_only_a_waiting_robot_accepts_resume_and_rejects_a_new_reference():
    rig = Rig()
    with pytest.raises(RefusedError, match="there is no drive to resume"):
        rig.loop.resume()
    rig.start_drive()
    with pytest.raises(RefusedError, match="there is no drive to resume"):
        rig.loop.resume()
    rig.on = False
    rig.run(3.0)
    with pytest.raises(RefusedError, match="odometry is 3"):
        rig.loop.resume()
    rig.on = True
    rig.run(1.0)
    with pytest.raises(RefusedError, match="call start or resume before a new reference"):
        rig.loop.set_reference(load_trajectory("square"))
    assert not rig.run(1.0).any()
    rig.loop.pause()
    assert rig.loop.start() == "resumed"
    assert rig.run(2.0)[-1, 0] > 0.2


def test_reference_offered_during_a_goal_stays_after_the_goal():
    rig = Rig()
    rig.start_drive()
    rig.loop.follow(load_trajectory("s"))
    rig.run(1.0)
    offered = load_trajectory("square")
    rig.loop.set_reference(offered)
    rig.loop.release()
    assert rig.loop.reference is offered
