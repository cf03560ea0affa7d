"""Topics of the simulated robot for navigation: transforms and a scan of its world."""

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
import ros_driver
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

from diffdrive_mpc import make_plant
from diffdrive_mpc.sim.ros.messages import nanoseconds
from diffdrive_mpc.sim.ros.pace import SteppedClock
from diffdrive_mpc.sim.ros.simulated_base import SimulatedBase, load_base_settings
from diffdrive_mpc.sim.sensing.odometry import Odometry
from diffdrive_mpc_extras.ros.navigation_topics import Scanner, transforms
from diffdrive_mpc_extras.worlds.world import World

START = (0.0, 0.0, 0.2)
ROOM = World(
    description="a wall ahead, a post to the left",
    time_limit=60.0,
    walls=[{"start": (2.0, -1.0), "end": (2.0, 1.0), "thickness": 0.2}],
    posts=[{"at": (0.0, 2.0), "radius": 0.5}],
    sight={"range_sd": 0.0, "latency": 0.06, "range": 3.0},
)


@pytest.fixture
def base(request, monkeypatch, tmp_path):
    """Return a robot on its topics that the test steps, with the plant and the settings of the parameter."""
    ros_driver.own_domain(monkeypatch, tmp_path)
    name, changes = request.param
    plant = make_plant(name, surface="default" if name.startswith("world") else "ideal")
    context = Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node("simulated_robot", context=context)
    settings, clock = load_base_settings(changes=changes), SteppedClock(500, plant.sample_time)
    made = SimulatedBase(node, plant, START, settings, pose_memory=5, clock=clock)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    made.executor, made.clock = executor, clock
    yield made
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


def drive(base, kind, topic, qos, command=(0.3, 0.4), ticks=60):
    """Drive the robot and return the received messages of a topic."""
    heard = []
    base.node.create_subscription(kind, topic, heard.append, qos)
    end = time.monotonic() + ros_driver.BOUND
    while not base.node.count_subscribers(topic) or base.executor.spin_once(timeout_sec=0.05):
        assert time.monotonic() < end
    for _ in range(ticks):
        now = base.clock.set_tick(base.tick)
        base.inbox.put(*command, 0, now)
        base.publish_sensors(now, base.clock.origin)
        base.advance(now)
        for _ in range(4):
            base.executor.spin_once(timeout_sec=0.005)
    return heard


def matrix(transform):
    position, turn = transform.transform.translation, transform.transform.rotation
    yaw = 2.0 * math.atan2(turn.z, turn.w)
    return np.array(
        [[math.cos(yaw), -math.sin(yaw), position.x], [math.sin(yaw), math.cos(yaw), position.y], [0.0, 0.0, 1.0]]
    )


class Publishers:
    """A node without ROS."""

    def create_publisher(self, kind, topic, qos):
        assert topic == "/tf"
        return SimpleNamespace(publish=lambda message: None)


@pytest.mark.parametrize("localised", [True, False])
def test_chain_of_transforms_from_map_to_base_is_the_true_pose(localised, monkeypatch):
    kind = SimpleNamespace(TFMessage=lambda transforms: SimpleNamespace(transforms=transforms))
    monkeypatch.setattr("diffdrive_mpc_extras.ros.navigation_topics.import_module", lambda name: kind)
    settings = load_base_settings(changes={"transforms": "map" if localised else "odom", "frame_prefix": "r1/"})
    plant = make_plant("model:ssm", surface="ideal")
    plant.reset(START)
    sender, odometry = transforms(Publishers(), plant, settings), Odometry(plant.true_pose, 5, use_pose_sensor=False)
    assert not list(sender.send(0, 0, None, plant))
    for tick in range(60):
        pose = odometry.update(plant.time, plant.measure())
        ((topic, message),) = sender.send(tick, 0, pose, plant)
        assert topic == "/tf"
        sent = {(each.header.frame_id, each.child_frame_id): each for each in message.transforms}
        assert set(sent) == {("r1/odom", "r1/base_link")} | ({("map", "r1/odom")} if localised else set())
        if localised:
            chain = matrix(sent["map", "r1/odom"]) @ matrix(sent["r1/odom", "r1/base_link"])
            np.testing.assert_allclose(chain[:2, 2], plant.true_pose[:2], atol=1e-9)
            turned = math.atan2(chain[1, 0], chain[0, 0]) - plant.true_pose[2]
            assert math.remainder(turned, math.tau) == pytest.approx(0.0, abs=1e-9)
        plant.advance((0.3, 0.4))


@pytest.mark.parametrize("base", [("world:doorway", {})], indirect=True)
def test_a_robot_in_a_world_sends_a_scan(base):
    heard = drive(base, LaserScan, "scan", qos_profile_sensor_data, command=(0.2, 0.0), ticks=50)
    assert 5 <= len(heard) <= 11
    scan = heard[-1]
    assert scan.header.frame_id == "base_link"
    assert len(scan.ranges) == round((scan.angle_max - scan.angle_min) / scan.angle_increment) + 1
    gaps = np.diff([nanoseconds(message.header.stamp) for message in heard])
    assert np.abs(gaps - 1e8).max() < 3e7
    assert np.isfinite(scan.ranges).any()


def test_ranges_are_those_of_the_world_and_arrive_late():
    scanner = Scanner(ROOM)
    assert scanner.look(0.0, (0.0, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    assert scanner.look(0.05, (0.5, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    scan = scanner.look(0.06, (0.5, 0.0, 0.0), lambda t: round(1e9 * t))
    assert nanoseconds(scan.header.stamp) == 0
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = np.array(scan.ranges)
    # From where it stood at the look: the wall's face at 1.9 m, the post's at 1.5 m.
    assert ranges[np.argmin(np.abs(angles))] == pytest.approx(1.9, abs=0.01)
    assert ranges[np.argmin(np.abs(angles - math.pi / 2))] == pytest.approx(1.5, abs=0.01)
    assert ranges[np.argmin(np.abs(angles + math.pi / 2))] == math.inf
