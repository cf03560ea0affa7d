"""The longest time between two commands while long messages arrive: `python tests/mpc/command_gaps.py [POSES...]`.

The node in a process of its own, in real time, as `diffdrive-mpc node` runs it; this process is robot and sender.
"""

import os
import subprocess
import sys
import threading
import time
from contextlib import suppress

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu

from diffdrive_mpc.mpc.ros.conversions import pose_message, stamped_pose_message, time_message

NODE = [sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()", "node", "--autostart"]
PERIOD = 0.02
ACCEPTED = 1000
# How long a message of a million poses was read before it was looked at, with room [s].
PATIENCE = 40e-6


class Robot:
    """Stands still, publishes sensors, and notes when commands come."""

    def __init__(self):
        self.node = rclpy.create_node("command_gaps")
        self.times = []
        self.node.create_subscription(TwistStamped, "cmd_vel", self.note, QoSProfile(depth=50))
        self.odom = self.node.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self.imu = self.node.create_publisher(Imu, "imu", qos_profile_sensor_data)
        self.path = self.node.create_publisher(Path, "set_path", 1)
        self.node.create_timer(PERIOD, self.publish)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        threading.Thread(target=self.spin, daemon=True).start()

    def spin(self):
        with suppress(ExternalShutdownException):
            self.executor.spin()

    def note(self, _):
        self.times.append(time.perf_counter())

    def publish(self):
        now = self.node.get_clock().now().nanoseconds
        odometry = Odometry(child_frame_id="base_link")
        odometry.header.stamp, odometry.header.frame_id = time_message(now), "odom"
        odometry.pose.pose = pose_message((0.0, 0.0, 0.0))
        self.odom.publish(odometry)
        imu = Imu()
        imu.header.stamp, imu.header.frame_id = time_message(now), "base_link"
        self.imu.publish(imu)

    def longest_gap(self, seconds):
        """Wait, and say the longest time between two commands meanwhile [s], a silence at the end included."""
        began = time.perf_counter()
        time.sleep(seconds)
        times = [at for at in self.times if at >= began - 0.1]
        return float(np.max(np.diff([*times, time.perf_counter()])))


def serialised(poses):
    """A path of so many poses; one that can be accepted is a slow drive ahead."""
    path = Path()
    path.header.frame_id = "odom"
    one = PoseStamped()
    one.header.frame_id = "odom"
    path.poses = [one] * poses
    if poses <= ACCEPTED:
        path.poses = [
            stamped_pose_message((0.3 * PERIOD * index, 0.0, 0.0), 10**9 + round(index * PERIOD * 1e9), "odom")
            for index in range(poses)
        ]
    return serialize_message(path)


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(counts):
    process = subprocess.Popen(NODE, stderr=subprocess.DEVNULL)
    rclpy.init()
    robot = Robot()
    try:
        while not robot.times or not robot.path.get_subscription_count():
            assert process.poll() is None, "the node has ended"
            time.sleep(0.1)
        time.sleep(3.0)
        say(f"nothing sent: {1e3 * robot.longest_gap(4.0):.0f} ms")
        for count in counts:
            raw = serialised(count)
            robot.path.publish(raw)
            gap = robot.longest_gap(4.0 + PATIENCE * count)
            say(f"{count} poses, {len(raw) / 1e6:.1f} MB: {1e3 * gap:.0f} ms")
    finally:
        process.terminate()
        process.wait(20.0)
        robot.executor.shutdown()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [1000, 20_000, 100_000, 1_000_000])
