"""The node under load: `python tests/mpc/loaded_node.py [--minutes 30]`, with every core kept busy by other processes.

The node in a process of its own drives circle after circle; this process is the robot, whose odometry falls silent
every 15 s for 2 s. Said are the time between two commands, memory and threads of the node, and how long each silence
took to bring the command to zero. It ends with 1 where memory grew, a stop was missed, or the node ended.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from std_srvs.srv import Trigger

from diffdrive_mpc.mpc.ros.conversions import pose_message, time_message
from fuzz.live.node_process import NodeProcess

PERIOD = 0.02
EVERY, SILENT = 15.0, 2.0
# Odometry is silent from 0.2 s on, half a second of braking follows; the rest is for a machine that is busy [s].
STOPPED_WITHIN = 1.2
# After a fifth of the time memory is as large as it gets [MB].
GROWTH = 5.0


class DrivenRobot:
    """Obeys its commands; its odometry falls silent from time to time."""

    def __init__(self):
        self.pose, self.twist, self.silent_since = np.zeros(3), [0.0, 0.0], None
        self.times, self.intervals, self.stops = [], [], []
        self.began = time.monotonic()
        self.node = rclpy.create_node("loaded_robot")
        self.node.create_subscription(TwistStamped, "cmd_vel", self.note, QoSProfile(depth=50))
        self.odom = self.node.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self.start = self.node.create_client(Trigger, "diffdrive_mpc/start")
        self.node.create_timer(PERIOD, self.publish)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        threading.Thread(target=self.spin, daemon=True).start()

    def spin(self):
        with suppress(ExternalShutdownException):
            self.executor.spin()

    def note(self, message):
        now = time.perf_counter()
        self.intervals += [now - self.times[-1]] if self.times else []
        self.times[:] = [now]
        self.twist = [message.twist.linear.x, message.twist.angular.z]
        if self.silent_since is not None and self.twist == [0.0, 0.0] and len(self.stops) and np.isnan(self.stops[-1]):
            self.stops[-1] = time.monotonic() - self.silent_since

    def publish(self):
        v, omega = self.twist
        self.pose += PERIOD * np.array([v * np.cos(self.pose[2]), v * np.sin(self.pose[2]), omega])
        if (time.monotonic() - self.began) % EVERY > EVERY - SILENT:
            if self.silent_since is None and abs(v) > 0.1:
                self.silent_since = time.monotonic()
                self.stops.append(np.nan)
            return
        self.silent_since = None
        now = self.node.get_clock().now().nanoseconds
        odometry = Odometry(child_frame_id="base_link")
        odometry.header.stamp, odometry.header.frame_id = time_message(now), "odom"
        odometry.pose.pose = pose_message(tuple(self.pose))
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = v, omega
        self.odom.publish(odometry)


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(minutes):
    # Whoever ends this process, they end.
    spin = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count())]
    node = NodeProcess(Path(tempfile.mkdtemp(), "node.log"), {"autostart": True, "start_at_robot": True})
    rclpy.init()
    robot, used = DrivenRobot(), []
    try:
        while not robot.times:
            assert node.alive, node.log.read_text()[-2000:]
            time.sleep(0.1)
        robot.began = time.monotonic()
        while time.monotonic() - robot.began < 60.0 * minutes and node.alive:
            if robot.silent_since is None and robot.twist == [0.0, 0.0]:
                robot.start.call_async(Trigger.Request())
            used.append(node.used())
            time.sleep(3.0)
    finally:
        ended = not node.alive
        node.end()
        for process in busy:
            process.kill()
            process.wait()
        robot.executor.shutdown()
        rclpy.try_shutdown()
    p50, p99, p999, worst = 1e3 * np.percentile(robot.intervals, (50, 99, 99.9, 100))
    memory, threads = np.array(used).T
    settled, stops = memory[len(memory) // 5], np.array(robot.stops)
    missed = int((~(stops <= STOPPED_WITHIN)).sum())
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    say(f"{len(robot.intervals)} commands in {minutes:g} minutes, {load}")
    say(f"between two of them [ms]: p50 {p50:.1f}, p99 {p99:.1f}, p99.9 {p999:.1f}, worst {worst:.1f}")
    say(f"memory [MB]: {memory[0]:.1f} at first, {settled:.1f} after a fifth, {memory[-1]:.1f} at the end")
    say(f"threads: {threads.min():.0f} to {threads.max():.0f}")
    after = f"zero {np.nanmedian(stops):.2f} s after the last odometry, {np.nanmax(stops):.2f} s at most"
    say(f"{len(stops)} stops, {missed} missed: {after}")
    return 1 if ended or missed or not len(stops) or memory[-1] - settled > GROWTH else 0


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--minutes", type=float, default=30.0)
    sys.exit(main(words.parse_args().minutes))
