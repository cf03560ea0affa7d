"""Driver of a robot at rest in a separate process: publishes messages of the given inputs until it is killed."""

import os
import subprocess
import sys
import time
from contextlib import contextmanager

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu

KINDS = {"odom": Odometry, "imu": Imu, "pose": PoseWithCovarianceStamped}
FRAMES = {"odom": "odom", "imu": "base_link", "pose": "map"}


def message_of(topic, stamp):
    """Return a message of `topic` for a robot at rest at the origin."""
    message = KINDS[topic]()
    message.header.stamp, message.header.frame_id = stamp, FRAMES[topic]
    if topic == "odom":
        message.child_frame_id = "base_link"
    if topic != "imu":
        message.pose.pose.orientation.w = 1.0
    return message


@contextmanager
def driver(topics, name="fake_base", rate=50.0):
    """Run a driver that publishes `topics`; kill it afterwards, so that its endpoints stay in the graph."""
    process = subprocess.Popen([sys.executable, __file__, name, str(rate), *topics])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def main(name, rate, *topics):
    rclpy.init(args=[])
    node = rclpy.create_node(name)
    publishers = {topic: node.create_publisher(KINDS[topic], topic, qos_profile_sensor_data) for topic in topics}
    parent = os.getppid()
    while os.getppid() == parent:  # also if the test crashes
        for topic, publisher in publishers.items():
            publisher.publish(message_of(topic, node.get_clock().now().to_msg()))
        time.sleep(1.0 / float(rate))


if __name__ == "__main__":
    main(*sys.argv[1:])
