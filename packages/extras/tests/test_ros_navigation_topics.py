"""Topics of the simulated robot for a navigation stack: transforms, and a scan of the world."""

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
    """Return a simulated base that the test steps, with the plant and the settings of the parameter."""
    ros_driver.own_domain(monkeypatch, tmp_path)
    name, changes = request.param
    plant = make_plant(name, surface="default" if name.startswith("world") else "ideal")
    context = Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node("simulated_robot", context=context)
    settings, clock = load_base_settings(changes=changes), SteppedClock(500, plant.sample_time)
    simulated = SimulatedBase(node, plant, START, settings, pose_memory=5, clock=clock)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    simulated.executor, simulated.clock = executor, clock
    yield simulated
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)


def drive(base, message_type, topic, qos, command=(0.3, 0.4), ticks=60):
    """Drive the robot and return the received messages of a topic."""
    received = []
    base.node.create_subscription(message_type, topic, received.append, qos)
    deadline = time.monotonic() + ros_driver.BOUND
    while not base.node.count_subscribers(topic) or base.executor.spin_once(timeout_sec=0.05):
        assert time.monotonic() < deadline
    for _ in range(ticks):
        now = base.clock.set_tick(base.tick)
        base.inbox.put(*command, 0, now)
        base.publish_sensors(now, base.clock.origin)
        base.advance(now)
        for _ in range(4):
            base.executor.spin_once(timeout_sec=0.005)
    return received


def matrix(transform):
    """Return the homogeneous transform (3, 3) of a TransformStamped in the plane."""
    position, rotation = transform.transform.translation, transform.transform.rotation
    yaw = 2.0 * math.atan2(rotation.z, rotation.w)
    return np.array(
        [[math.cos(yaw), -math.sin(yaw), position.x], [math.sin(yaw), math.cos(yaw), position.y], [0.0, 0.0, 1.0]]
    )


class NodeStub:
    """Node with a publisher that discards its messages."""

    def create_publisher(self, message_type, topic, qos):
        assert topic == "/tf"
        return SimpleNamespace(publish=lambda message: None)


@pytest.mark.parametrize("localised", [True, False])
def test_chain_of_transforms_from_map_to_base_is_the_true_pose(localised, monkeypatch):
    module = SimpleNamespace(TFMessage=lambda transforms: SimpleNamespace(transforms=transforms))
    monkeypatch.setattr("diffdrive_mpc_extras.ros.navigation_topics.import_module", lambda name: module)
    settings = load_base_settings(changes={"transforms": "map" if localised else "odom", "frame_prefix": "r1/"})
    plant = make_plant("model:ssm", surface="ideal")
    plant.reset(START)
    sender, odometry = transforms(NodeStub(), plant, settings), Odometry(plant.true_pose, 5, use_pose_sensor=False)
    assert not list(sender.send(0, 0, None, plant))
    for tick in range(60):
        pose = odometry.update(plant.time, plant.measure())
        ((topic, message),) = sender.send(tick, 0, pose, plant)
        assert topic == "/tf"
        by_frames = {(entry.header.frame_id, entry.child_frame_id): entry for entry in message.transforms}
        assert set(by_frames) == {("r1/odom", "r1/base_link")} | ({("map", "r1/odom")} if localised else set())
        if localised:
            chain = matrix(by_frames["map", "r1/odom"]) @ matrix(by_frames["r1/odom", "r1/base_link"])
            np.testing.assert_allclose(chain[:2, 2], plant.true_pose[:2], atol=1e-9)
            heading_error = math.atan2(chain[1, 0], chain[0, 0]) - plant.true_pose[2]
            assert math.remainder(heading_error, math.tau) == pytest.approx(0.0, abs=1e-9)
        plant.advance((0.3, 0.4))


@pytest.mark.parametrize("base", [("world:doorway", {})], indirect=True)
def test_robot_in_a_world_publishes_scans(base):
    received = drive(base, LaserScan, "scan", qos_profile_sensor_data, command=(0.2, 0.0), ticks=50)
    assert 5 <= len(received) <= 11
    scan = received[-1]
    assert scan.header.frame_id == "base_link"
    assert len(scan.ranges) == round((scan.angle_max - scan.angle_min) / scan.angle_increment) + 1
    periods = np.diff([nanoseconds(message.header.stamp) for message in received])
    assert np.abs(periods - 1e8).max() < 3e7
    assert np.isfinite(scan.ranges).any()


def test_scan_has_the_true_ranges_and_arrives_after_the_latency():
    scanner = Scanner(ROOM)
    assert scanner.scan(0.0, (0.0, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    assert scanner.scan(0.05, (0.5, 0.0, 0.0), lambda t: round(1e9 * t)) is None
    scan = scanner.scan(0.06, (0.5, 0.0, 0.0), lambda t: round(1e9 * t))
    assert nanoseconds(scan.header.stamp) == 0
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = np.array(scan.ranges)
    # Ranges from the pose at the time of measurement: 1.9 m to the wall and 1.5 m to the post.
    assert ranges[np.argmin(np.abs(angles))] == pytest.approx(1.9, abs=0.01)
    assert ranges[np.argmin(np.abs(angles - math.pi / 2))] == pytest.approx(1.5, abs=0.01)
    assert ranges[np.argmin(np.abs(angles + math.pi / 2))] == math.inf
