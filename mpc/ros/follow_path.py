"""The action server `follow_path` (nav2_msgs/action/FollowPath): Nav2's behaviour tree drives the robot through it.

It has its own node and thread: to take a path of some thousand poses apart takes longer than a tick.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import numpy as np
import rclpy
from nav2_msgs.action import FollowPath
from nav_msgs.msg import Path
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.task import Future

from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.table import plain_line
from diffdrive_mpc.mpc.ros.conversions import MessageError, nanoseconds, planar_pose
from diffdrive_mpc.mpc.ros.follow_clients import ClientWatch
from diffdrive_mpc.mpc.ros.follow_goal import Code, End, FollowGoal, Following, GoalOutcome
from diffdrive_mpc.mpc.ros.settings import NodeSettings

ACTION = "follow_path"
_REQUESTS = QoSProfile(depth=2000)
"""Depth of the request queue: with the services' default of 10, the middleware drops requests that arrive while others
are read.
"""
_RESULTS_AT_ONCE = 4
"""Results sent in one look: a client has room for 10 that it has not read."""
_LONG_WORK = 0.005
"""After work that took longer [s] the thread rests as long: the interpreter runs one thread at a time, and the loop's
has priority.
"""
_RESULT_KEPT = 60
"""Time for which a result waits for its client [s]: a client that sends hundreds of goals a second reads results late.
"""
_MIN_CHECK_RATE = 10.0
"""Lowest rate of feedback while the clients are observed [Hz]."""
_LOOK = 0.02
"""Period of the check for finished goals [s]."""
_FAREWELL = 0.4
"""Time limit for the last results [s]."""


class _Server(ActionServer):
    """Action server that keeps the sequence number of the goal request that it handles, which rclpy hides."""

    sequence_number = 0

    async def _execute_goal_request(self, request_header_and_message: tuple[Any, Any]) -> None:
        self.sequence_number = int(request_header_and_message[0].sequence_number)
        await super()._execute_goal_request(request_header_and_message)


class FollowPathServer:
    """Accept goals while there is a `Following` to take them, and report their results to clients.

    Parameters
    ----------
    node
        The node that drives; its name, namespace and remappings count.
    settings
        The node's.
    """

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        self._node, self._settings = node, settings
        self._following: Following | None = None
        self._incoming: deque[tuple[Following, FollowGoal]] = deque()
        self._open: list[tuple[FollowGoal, ServerGoalHandle, Future]] = []
        self._arrived = node.create_guard_condition(self._pass_on)
        self._side = rclpy.create_node(
            f"{node.get_name()}_{ACTION}",
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
        )
        # As the node's own remappings have it.
        action = node.resolve_topic_name(ACTION)
        self._clients: dict[bytes, frozenset[bytes]] = {}
        self._watch = ClientWatch(self._side, action)
        self._server = _Server(
            self._side,
            FollowPath,
            action,
            self._execute,
            goal_callback=self._judge,
            handle_accepted_callback=self._accepted,
            cancel_callback=self._cancel,
            goal_service_qos_profile=_REQUESTS,
            result_service_qos_profile=_REQUESTS,
            cancel_service_qos_profile=_REQUESTS,
            result_timeout=_RESULT_KEPT,
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._side.create_timer(_LOOK, self._look, clock=steady)
        rate = max(settings.follow_feedback_rate, _MIN_CHECK_RATE if settings.follow_blind_distance else 0.0)
        self._side.create_timer(1.0 / rate, self._tell, clock=steady)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(self._side)
        self._closing = self._said = False
        self._thread = threading.Thread(target=self._spin, name=ACTION, daemon=True)
        self._thread.start()

    def open(self, following: Following) -> None:
        """Accept goals from now on, for `following`."""
        self._following = following

    def shut(self, why: str) -> None:
        """Accept no goals from now on, and end those there are."""
        following, self._following = self._following, None
        while self._incoming:
            _, goal = self._incoming.popleft()
            goal.end = End(GoalOutcome.ABORTED, Code.UNKNOWN, why)
        if following is not None:
            following.stop(why)

    def close(self) -> None:
        """Send the last results, and end."""
        self._said = bool(self._open)
        self.shut("the node is shut down")
        self._closing = True
        self._thread.join(2.0 * _FAREWELL)
        self._server.destroy()
        self._watch.destroy()
        self._executor.shutdown()
        self._side.destroy_node()
        self._node.destroy_guard_condition(self._arrived)

    def _spin(self) -> None:
        left = round(_FAREWELL / _LOOK)
        while not self._closing or (self._said and left > 0):
            began = time.thread_time()
            try:
                self._executor.spin_once(timeout_sec=_LOOK)
            except ExternalShutdownException:
                return
            except Exception as error:  # a fault of one goal must not block the results of all others
                words = f"{ACTION}: {type(error).__name__}: {plain_line(str(error))}"
                self._node.get_logger().error(words, throttle_duration_sec=_FAREWELL)
                time.sleep(_LOOK)
            worked = time.thread_time() - began
            if worked > _LONG_WORK:
                time.sleep(worked)
            left -= self._closing

    def _pass_on(self) -> None:
        """Forward queued goals in the thread of the loop."""
        while self._incoming:
            following, goal = self._incoming.popleft()
            if following is self._following:
                following.take(goal)
            else:
                goal.end = End(GoalOutcome.ABORTED, Code.UNKNOWN, "the node was deactivated")

    def _judge(self, _: FollowPath.Goal) -> GoalResponse:
        if self._following is None:
            self._node.get_logger().error(f"{ACTION}: goal refused: the node is not active; activate it first")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _accepted(self, handle: ServerGoalHandle) -> None:
        self._clients[bytes(handle.goal_id.uuid)] = self._watch.claim(self._server.sequence_number)
        handle.execute()

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for goal, held, _ in self._open:
            if bytes(held.goal_id.uuid) == bytes(handle.goal_id.uuid):
                goal.cancelled = True
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, handle: ServerGoalHandle) -> FollowPath.Result:
        end = self._begin(handle, self._clients.pop(bytes(handle.goal_id.uuid)))
        if isinstance(end, Future):
            end = await end
        self._log(end)
        {
            GoalOutcome.SUCCEEDED: handle.succeed,
            GoalOutcome.CANCELED: handle.canceled,
            GoalOutcome.ABORTED: handle.abort,
        }[end.outcome]()
        result = FollowPath.Result(error_code=int(end.code))
        # Nav2 has had it since its first release for Jazzy; older definitions have not.
        if hasattr(result, "error_msg"):
            result.error_msg = "" if end.outcome is GoalOutcome.SUCCEEDED else end.words
        return result

    def _begin(self, handle: ServerGoalHandle, clients: frozenset[bytes]) -> Future | End:
        """Pass a goal to the loop; return the future of its end, or its end."""
        request, following, settings = handle.request, self._following, self._settings
        # A fault ends the drive that the goal was to replace, too: that is the loop's to do.
        poses, fault = np.zeros((0, 3)), None
        try:
            poses = path_poses(request.path, settings.follow_most_poses)
        except MessageError as error:
            fault = (Code.INVALID_PATH, str(error))
        if settings.follow_controller_id and request.controller_id not in ("", settings.follow_controller_id):
            why = f"controller_id is '{request.controller_id}', here it is '{settings.follow_controller_id}'"
            fault = (Code.INVALID_CONTROLLER, f"{why} (parameter follow_controller_id)")
        if following is None:
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, "the node was deactivated")
        header = request.path.header
        goal = FollowGoal(poses, header.frame_id, nanoseconds(header.stamp), fault=fault, clients=clients)
        # The handle keeps its request as long as its result, and collecting that many objects would stop the loop for a
        # second.
        request.path = Path()
        future = Future(executor=self._executor)
        self._open.append((goal, handle, future))
        self._incoming.append((following, goal))
        self._arrived.trigger()
        return future

    def _look(self) -> None:
        """Pass on the ends of goals to the waiting clients."""
        ended = [entry for entry in self._open if entry[0].end is not None]
        for entry in ended if self._closing else ended[:_RESULTS_AT_ONCE]:
            self._open.remove(entry)
            entry[2].set_result(entry[0].end)

    def _tell(self) -> None:
        now = time.monotonic()
        heard_goals = self._watch.check([goal.clients for goal, _, _ in self._open])
        for (goal, _, _), heard in zip(self._open, heard_goals, strict=True):
            goal.unheard = 0 if heard else goal.unheard + 1
            if heard:
                goal.heard_at = now
        for goal, handle, _ in self._open:
            if goal.progress is not None and goal.end is None:
                distance, speed = goal.progress
                feedback = FollowPath.Feedback(distance_to_goal=distance, speed=speed)
                self._watch.send(FollowPath.Impl.FeedbackMessage(goal_id=handle.goal_id, feedback=feedback))

    def _log(self, end: End) -> None:
        log = self._node.get_logger()
        words = f"{ACTION}: {end.outcome}{f' ({end.code.name})' if end.code else ''}: {end.words}"
        # One line for each severity: a logger refuses a line that changes it from call to call.
        if end.outcome is GoalOutcome.ABORTED and end.code:
            log.error(words)
        else:
            log.info(words)


def path_poses(message: Path, most: int) -> FloatArray:
    """Extract poses (n, 3) of a path; raise MessageError if they are invalid, too many, or in different frames."""
    frame, count = message.header.frame_id, len(message.poses)
    if count > most:
        raise MessageError(f"the path has {count} poses, the most is {most} (parameter follow_most_poses)")
    rows = []
    for index, pose in enumerate(message.poses):
        if (pose.header.frame_id or frame) != frame:
            raise MessageError(f"pose {index} is in '{pose.header.frame_id}', the path in '{frame}': give it one frame")
        try:
            rows.append(planar_pose(pose.pose))
        except MessageError as error:
            raise MessageError(f"pose {index}: {error}") from error
    return np.array(rows, dtype=float).reshape(-1, 3)
