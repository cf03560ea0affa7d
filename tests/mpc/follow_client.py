"""Client of follow_path in a separate process: reads commands and writes events as lines of JSON.

Input: {"send": id, "frame": .., "poses": [[x, y, theta], ..], "controller": ..} or {"cancel": id}. {"burst": id,
"goals": [{"poses": .., ..}, ..], "times": count, "rate": Hz} sends these goals in turn, as "id 0", "id 1", ...
Output: {"id": .., "event": .., ..}.
"""

import json
import math
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import FollowPath
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile


def write_event(**fields):
    sys.stdout.write(json.dumps(fields | {"time": time.monotonic()}) + "\n")
    sys.stdout.flush()


def goal_message(line):
    goal = FollowPath.Goal(controller_id=line.get("controller", ""))
    goal.path.header.frame_id = line.get("frame", "odom")
    for x, y, theta in line["poses"]:
        pose = PoseStamped()
        pose.header.frame_id = goal.path.header.frame_id
        pose.pose.position.x, pose.pose.position.y = float(x), float(y)
        pose.pose.orientation.z, pose.pose.orientation.w = math.sin(theta / 2), math.cos(theta / 2)
        goal.path.poses.append(pose)
    return goal


class Client:
    def __init__(self):
        rclpy.init(args=[])
        self.node = rclpy.create_node("planner_of_the_test")
        # On a busy computer, the client would lose events beyond the default queue size of services, 10.
        queue = QoSProfile(depth=1000)
        self.action = ActionClient(
            self.node, FollowPath, "follow_path", goal_service_qos_profile=queue, result_service_qos_profile=queue
        )
        self.handles = {}
        self.lines = []
        self.due = []
        self.ended = False
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        for line in sys.stdin:
            self.lines.append(json.loads(line))
        self.ended = True

    def run(self):
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        while not self.action.server_is_ready() and not self.ended:
            executor.spin_once(timeout_sec=0.05)
        write_event(event="ready")
        while not self.ended:
            while self.lines:
                self.act(self.lines.pop(0))
            while self.due and self.due[0][0] <= time.monotonic():
                self.submit(*self.due.pop(0)[1:])
            # Each goal takes several messages.
            for _ in range(5):
                executor.spin_once(timeout_sec=0.002)

    def act(self, line):
        if "cancel" in line:
            self.handles[line["cancel"]].cancel_goal_async()
        elif "burst" in line:
            goals = [goal_message(goal) for goal in line["goals"]]
            now, period = time.monotonic(), 1.0 / line["rate"]
            self.due = [(now + i * period, f"{line['burst']} {i}", goals[i % len(goals)]) for i in range(line["times"])]
        else:
            self.submit(line["send"], goal_message(line))

    def submit(self, name, goal):
        future = self.action.send_goal_async(
            goal, feedback_callback=lambda message: self.report_feedback(name, message.feedback)
        )
        future.add_done_callback(lambda future: self.report_acceptance(name, future.result()))

    def report_feedback(self, name, feedback):
        write_event(id=name, event="feedback", distance=feedback.distance_to_goal, speed=feedback.speed)

    def report_acceptance(self, name, handle):
        write_event(id=name, event="accepted" if handle.accepted else "rejected")
        if handle.accepted:
            self.handles[name] = handle
            handle.get_result_async().add_done_callback(lambda future: self.report_result(name, future.result()))

    def report_result(self, name, reply):
        self.handles.pop(name, None)
        write_event(
            id=name,
            event="result",
            status=int(reply.status),
            code=int(reply.result.error_code),
            words=reply.result.error_msg,
        )


if __name__ == "__main__":
    Client().run()
