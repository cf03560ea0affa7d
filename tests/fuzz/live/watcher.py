"""A process that hears what the robot's base would hear, and writes it down: `python -m fuzz.live.watcher FILE`.

It knows nothing of the node but its topics. Each line: what it is, the monotonic time of its arrival [s], and
content; of commands the number that the sender's middleware gave them, so that one that was lost on the way is known.
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String


def watch(out: TextIO) -> None:
    """Until a signal, or the end of whoever started it."""
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    node = rclpy.create_node("watcher")

    def write(kind: str, *content: object) -> None:
        out.write(json.dumps([kind, time.monotonic(), *content]) + "\n")

    def command(message: TwistStamped, info: dict[str, Any]) -> None:
        twist = message.twist
        others = [twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y]
        number = info.get("publication_sequence_number") if isinstance(info, dict) else None
        write("command", twist.linear.x, twist.angular.z, number, any(others))

    node.create_subscription(TwistStamped, "cmd_vel", command, QoSProfile(depth=1000))
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_subscription(String, "/diffdrive_mpc/mode", lambda message: write("mode", message.data), latched)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    write("ready")
    flushed = 0.0
    while rclpy.ok():
        executor.spin_once(timeout_sec=0.05)
        if time.monotonic() - flushed > 0.1:
            flushed = time.monotonic()
            out.flush()
            if _orphaned():
                break


def _orphaned() -> bool:
    """Whether whoever started it is gone."""
    return os.getppid() == 1


if __name__ == "__main__":
    with suppress(ExternalShutdownException, KeyboardInterrupt), Path(sys.argv[1]).open("w", encoding="utf-8") as file:
        watch(file)
