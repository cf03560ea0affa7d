"""Load test of the node with every core kept busy by other processes: `python tests/mpc/loaded_node.py [--minutes 30]`.

A node drives circle after circle; this process simulates the robot, whose sensors are silent for 2 s of every 10 s. It
prints the time between two commands, memory and threads of the node, and the time of each stop. The exit code is 1 if
memory grew, a stop was missed, or the node ended.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from fuzz.live.base import Base
from fuzz.live.node_process import NodeProcess

PERIOD, SILENT = 10.0, 2.0
# Odometry times out after 0.2 s, then the robot brakes for half a second; the rest is a margin for a busy machine [s].
STOPPED_WITHIN = 1.2
# Permitted growth of memory after the first fifth of the time [MB].
MAX_GROWTH = 5.0


def drive(node, minutes):
    """Drive; return the base, the times at which its sensors fell silent [s], and memory and threads of the node."""
    robot = rclpy.create_node("loaded_robot")
    base, start = Base(robot, sim_time=False), robot.create_client(Trigger, "diffdrive_mpc/start")
    executor = SingleThreadedExecutor()
    executor.add_node(robot)
    silences, used, start_time, polled = [], [], None, 0.0
    while node.alive and (start_time is None or time.monotonic() - start_time < 60.0 * minutes):
        executor.spin_once(timeout_sec=0.005)
        now = time.monotonic()
        if start_time is None and base.commands:
            start_time = now
        silent = start_time is not None and (now - start_time) % PERIOD > PERIOD - SILENT
        if silent and not base.silent and abs(base.command[0]) > 0.1:
            silences.append(now)
        base.silent = silent
        base.tick_if_due()
        if start_time is not None and now - polled > 3.0:
            polled = now
            used.append(node.used())
            if not silent and base.command == [0.0, 0.0]:
                start.call_async(Trigger.Request())
    executor.shutdown()
    return base, silences, np.array(used)


def main(minutes):
    # The processes end with this process.
    spin = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count())]
    node = NodeProcess(Path(tempfile.mkdtemp(), "node.log"), {"autostart": True, "start_at_robot": True})
    rclpy.init()
    try:
        base, silences, used = drive(node, minutes)
    finally:
        ended = not node.alive
        node.end()
        for process in busy:
            process.kill()
            process.wait()
        rclpy.try_shutdown()
    assert len(used), node.log.read_text()[-2000:]
    times = np.array([command.time for command in base.commands])
    at_rest = np.array([command.time for command in base.commands if command.v == command.omega == 0.0])
    # A silence that begins shortly before the end is not judged.
    judged = [silence for silence in silences if silence < times[-1] - STOPPED_WITHIN]
    stops = np.array([min(at_rest[at_rest > silence] - silence, default=np.nan) for silence in judged])
    p50, p99, p999, worst = 1e3 * np.percentile(np.diff(times), (50, 99, 99.9, 100))
    memory, threads = used.T
    settled, missed = memory[len(memory) // 5], int((~(stops <= STOPPED_WITHIN)).sum())
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    print(f"{len(times)} commands in {minutes:g} minutes, {load}")
    print(f"between two of them [ms]: p50 {p50:.1f}, p99 {p99:.1f}, p99.9 {p999:.1f}, worst {worst:.1f}")
    print(f"memory [MB]: {memory[0]:.1f} at first, {settled:.1f} after a fifth, {memory[-1]:.1f} at the end")
    print(f"threads: {threads.min():.0f} to {threads.max():.0f}")
    after = f"zero {np.nanmedian(stops):.2f} s after the last odometry, {np.nanmax(stops):.2f} s at most"
    print(f"{len(stops)} stops, {missed} missed: {after}")
    return 1 if ended or missed or not len(stops) or memory[-1] - settled > MAX_GROWTH else 0


if __name__ == "__main__":
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--minutes", type=float, default=30.0)
    sys.exit(main(words.parse_args().minutes))
