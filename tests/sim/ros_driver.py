"""Driver of the simulated robot in tests: a separate node, over real DDS."""

import threading
import time

import numpy as np
import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from ros_domain import own_domain
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock

from diffdrive_mpc.sim.ros.simulated_base import load_base_settings

DOMAIN = own_domain()
"""ROS domain of this test process, so that it cannot drive the robot of another process."""
BOUND = 120.0
"""Time limit of every wait [s]."""
FIRST_TICK = load_base_settings().lock_step.first_tick


def own_domain(monkeypatch, folder):
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(folder))


class Driver(threading.Thread):
    """Node that answers each tick of /clock with a row of the commands; removes its publisher after the last row.

    `stamp` maps the time of a tick [ns] to the stamp of its command.
    """

    def __init__(self, commands, sample_time, *, stamped=True, stamp=lambda now: now):
        super().__init__(daemon=True)
        self.commands, self.sample, self.stamped, self.stamp = commands, sample_time, stamped, stamp
        self.odometry, self.finished, self.done = [], False, threading.Event()

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.done.set()
        self.join(BOUND)

    def run(self):
        context = Context()
        rclpy.init(context=context, domain_id=int(DOMAIN))
        node = rclpy.create_node("driver", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        clock_qos = QoSProfile(depth=1, reliability=rclpy.qos.ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(Odometry, "odom", self.odometry.append, qos_profile_sensor_data)
        node.create_subscription(Clock, "/clock", self.send_command, clock_qos)
        self.publisher = node.create_publisher(TwistStamped if self.stamped else Twist, "cmd_vel", QoSProfile(depth=1))
        deadline = time.monotonic() + BOUND
        while not self.done.is_set() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
            if self.finished:
                node.destroy_publisher(self.publisher)
                self.finished = False
        executor.shutdown()
        node.destroy_node()
        context.shutdown()

    def send_command(self, message):
        now = message.clock.sec * 10**9 + message.clock.nanosec
        tick = round(now * 1e-9 / self.sample) - FIRST_TICK
        if tick < 0:
            return
        if tick >= len(self.commands):
            self.finished = tick == len(self.commands)
            return
        stamped_message = TwistStamped()
        twist = stamped_message.twist
        stamped_message.header.stamp.sec, stamped_message.header.stamp.nanosec = divmod(self.stamp(now), 10**9)
        twist.linear.x, twist.angular.z = (float(value) for value in self.commands[tick])
        self.publisher.publish(stamped_message if self.stamped else twist)


def read_messages(bag, topic):
    """Read stamps [ns] and messages of a topic in a bag."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        result = [store.deserialize_cdr(data, c.msgtype) for c, _, data in reader.messages(connections=connections)]
    return np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in result]), result


def read_true_poses(bag):
    """Read (n, 3) true x [m], y [m], theta [rad]."""
    poses = [message.pose for message in read_messages(bag, "/ground_truth/pose")[1]]
    return np.array([[p.position.x, p.position.y, 2 * np.arctan2(p.orientation.z, p.orientation.w)] for p in poses])
