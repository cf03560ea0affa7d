"""Generated ROS types carry messages and an action between two processes."""

import subprocess
import sys
import time

import pytest
from ros_domain import own_domain

DOMAIN = own_domain()
PATIENCE = 60.0
# It answers a goal with feedback and a result, and publishes what it knows, until its input ends.
SERVER = """
import sys, threading, rclpy
from bond.msg import Status
from geometry_msgs.msg import TransformStamped
from nav2_msgs.action import FollowPath
from nav2_msgs.msg import SpeedLimit
from rclpy.action import ActionServer
from tf2_msgs.msg import TFMessage

rclpy.init(args=[])
node = rclpy.create_node("server")
tf, speed, bond = (node.create_publisher(kind, name, 1) for kind, name in (
    (TFMessage, "tf"), (SpeedLimit, "speed_limit"), (Status, "bond")))

def execute(goal):
    path = goal.request.path
    goal.publish_feedback(FollowPath.Feedback(distance_to_goal=float(len(path.poses)), speed=0.25))
    goal.abort()
    return FollowPath.Result(error_code=FollowPath.Result.INVALID_PATH, error_msg=path.header.frame_id + "?")

def publish():
    transform = TransformStamped(child_frame_id="base_link")
    transform.transform.translation.x = 1.5
    tf.publish(TFMessage(transforms=[transform, transform]))
    speed.publish(SpeedLimit(percentage=True, speed_limit=12.5))
    bond.publish(Status(id="a", instance_id="b", active=True, heartbeat_timeout=4.0, heartbeat_period=0.5))

server = ActionServer(node, FollowPath, "follow_path", execute)
timer = node.create_timer(0.05, publish)
threading.Thread(target=lambda: (sys.stdin.read(), rclpy.shutdown()), daemon=True).start()
try:
    rclpy.spin(node)
except BaseException:
    pass
"""


@pytest.fixture
def client(ros_types, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", DOMAIN)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    server = subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE)
    context = Context()
    rclpy.init(context=context, args=[])
    node = rclpy.create_node("client", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def until(condition):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.05)

    yield node, until
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
    server.stdin.close()
    server.wait(PATIENCE)


def test_another_process_receives_what_was_sent(client):
    from bond.msg import Status
    from nav2_msgs.action import FollowPath
    from nav2_msgs.msg import SpeedLimit
    from nav_msgs.msg import Path
    from rclpy.action import ActionClient
    from tf2_msgs.msg import TFMessage

    node, until = client
    heard = {}
    for kind, name in ((TFMessage, "tf"), (SpeedLimit, "speed_limit"), (Status, "bond")):
        node.create_subscription(kind, name, lambda message, name=name: heard.__setitem__(name, message), 1)
    until(lambda: len(heard) == 3)
    assert [one.transform.translation.x for one in heard["tf"].transforms] == [1.5, 1.5]
    assert (heard["speed_limit"].percentage, heard["speed_limit"].speed_limit) == (True, 12.5)
    assert (heard["bond"].instance_id, heard["bond"].heartbeat_timeout) == ("b", 4.0)

    follow = ActionClient(node, FollowPath, "follow_path")
    until(follow.server_is_ready)
    goal = FollowPath.Goal(path=Path(), controller_id="x")
    goal.path.header.frame_id = "map"
    goal.path.poses = [*goal.path.poses, *(_pose() for _ in range(1000))]
    said = []
    sent = follow.send_goal_async(goal, feedback_callback=lambda message: said.append(message.feedback))
    until(sent.done)
    assert sent.result().accepted
    answer = sent.result().get_result_async()
    until(lambda: answer.done() and said)
    result = answer.result().result
    assert (result.error_code, result.error_msg) == (FollowPath.Result.INVALID_PATH, "map?")
    assert (said[0].distance_to_goal, said[0].speed) == (1000.0, 0.25)
    follow.destroy()


def _pose():
    from geometry_msgs.msg import PoseStamped

    return PoseStamped()


def test_missing_generators_raise_one_line(tmp_path, monkeypatch):
    from ros_types import build

    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(RuntimeError, match=r"no generators .* pip install"):
        build.built_types()
