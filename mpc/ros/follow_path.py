"""Action server `follow_path` (nav2_msgs/action/FollowPath), through which Nav2's behaviour tree drives the robot.

The server has a separate node and thread, since the conversion of a path of several thousand poses takes longer than a
tick.
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
"""QoS of the request queues. With the default depth of 10, the middleware drops requests if many arrive at once."""
_MAX_RESULTS = 4
"""Maximum number of results per period; the queue of a client has a depth of 10."""
_LONG_WORK = 0.005
"""Computation time after which the thread sleeps for the same time [s], so that the control loop can run."""
_RESULT_TIMEOUT = 60
"""Time for which a result is stored for its client [s]; a client with hundreds of goals per second is late."""
_MIN_CHECK_RATE = 10.0
"""Minimum rate of feedback while the clients are monitored [Hz]."""
_POLL_PERIOD = 0.02
"""Period of the check for finished goals [s]."""
_CLOSE_TIMEOUT = 0.4
"""Time limit for sending the last results [s]."""


class _Server(ActionServer):
    """Action server that stores the sequence number of the current goal request, which rclpy does not expose."""

    sequence_number = 0

    async def _execute_goal_request(self, request_header_and_message: tuple[Any, Any]) -> None:
        self.sequence_number = int(request_header_and_message[0].sequence_number)
        await super()._execute_goal_request(request_header_and_message)


class FollowPathServer:
    """Action server that passes goals to a `Following` and sends the results to the clients.

    Parameters
    ----------
    node
        Node of the control loop; the server uses its name, namespace and remappings.
    settings
        Settings of the node.
    """

    def __init__(self, node: Node, settings: NodeSettings) -> None:
        self._node, self._settings = node, settings
        self._following: Following | None = None
        self._incoming: deque[tuple[Following, FollowGoal]] = deque()
        self._goals: list[tuple[FollowGoal, ServerGoalHandle, Future]] = []
        self._goal_arrived = node.create_guard_condition(self._forward_goals)
        self._server_node = rclpy.create_node(
            f"{node.get_name()}_{ACTION}",
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
        )
        # The action uses the remappings of the node.
        action = node.resolve_topic_name(ACTION)
        self._clients: dict[bytes, frozenset[bytes]] = {}
        self._watch = ClientWatch(self._server_node, action)
        self._server = _Server(
            self._server_node,
            FollowPath,
            action,
            self._execute,
            goal_callback=self._handle_request,
            handle_accepted_callback=self._accept_goal,
            cancel_callback=self._cancel,
            goal_service_qos_profile=_REQUESTS,
            result_service_qos_profile=_REQUESTS,
            cancel_service_qos_profile=_REQUESTS,
            result_timeout=_RESULT_TIMEOUT,
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._server_node.create_timer(_POLL_PERIOD, self._send_results, clock=steady)
        rate = max(settings.follow_feedback_rate, _MIN_CHECK_RATE if settings.follow_blind_distance else 0.0)
        self._server_node.create_timer(1.0 / rate, self._send_feedback, clock=steady)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(self._server_node)
        self._closing = self._has_results = False
        self._thread = threading.Thread(target=self._spin, name=ACTION, daemon=True)
        self._thread.start()

    def open(self, following: Following) -> None:
        """Accept goals and pass them to `following`."""
        self._following = following

    def end_goals(self, reason: str) -> None:
        """Reject new goals and end the current goals."""
        following, self._following = self._following, None
        while self._incoming:
            _, goal = self._incoming.popleft()
            goal.end = End(GoalOutcome.ABORTED, Code.UNKNOWN, reason)
        if following is not None:
            following.stop(reason)

    def close(self) -> None:
        """Send the last results and stop the server."""
        self._has_results = bool(self._goals)
        self.end_goals("the node is shut down")
        self._closing = True
        self._thread.join(2.0 * _CLOSE_TIMEOUT)
        self._server.destroy()
        self._watch.destroy()
        self._executor.shutdown()
        self._server_node.destroy_node()
        self._node.destroy_guard_condition(self._goal_arrived)

    def _spin(self) -> None:
        polls_left = round(_CLOSE_TIMEOUT / _POLL_PERIOD)
        while not self._closing or (self._has_results and polls_left > 0):
            start = time.thread_time()
            try:
                self._executor.spin_once(timeout_sec=_POLL_PERIOD)
            except ExternalShutdownException:
                return
            except Exception as error:  # an error of one goal must not block the results of other goals
                text = f"{ACTION}: {type(error).__name__}: {plain_line(str(error))}"
                self._node.get_logger().error(text, throttle_duration_sec=_CLOSE_TIMEOUT)
                time.sleep(_POLL_PERIOD)
            busy_time = time.thread_time() - start
            if busy_time > _LONG_WORK:
                time.sleep(busy_time)
            polls_left -= self._closing

    def _forward_goals(self) -> None:
        """Forward queued goals, in the thread of the control loop."""
        while self._incoming:
            following, goal = self._incoming.popleft()
            if following is self._following:
                following.receive(goal)
            else:
                goal.end = End(GoalOutcome.ABORTED, Code.UNKNOWN, "the node was deactivated")

    def _handle_request(self, _: FollowPath.Goal) -> GoalResponse:
        if self._following is None:
            self._node.get_logger().error(f"{ACTION}: goal refused: the node is not active; activate it first")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _accept_goal(self, handle: ServerGoalHandle) -> None:
        self._clients[bytes(handle.goal_id.uuid)] = self._watch.claim(self._server.sequence_number)
        handle.execute()

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for goal, goal_handle, _ in self._goals:
            if bytes(goal_handle.goal_id.uuid) == bytes(handle.goal_id.uuid):
                goal.cancelled = True
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    async def _execute(self, handle: ServerGoalHandle) -> FollowPath.Result:
        end = self._submit(handle, self._clients.pop(bytes(handle.goal_id.uuid)))
        if isinstance(end, Future):
            end = await end
        self._log(end)
        {
            GoalOutcome.SUCCEEDED: handle.succeed,
            GoalOutcome.CANCELED: handle.canceled,
            GoalOutcome.ABORTED: handle.abort,
        }[end.outcome]()
        result = FollowPath.Result(error_code=int(end.code))
        # This field was added with the first release of Nav2 for Jazzy.
        if hasattr(result, "error_msg"):
            result.error_msg = "" if end.outcome is GoalOutcome.SUCCEEDED else end.message
        return result

    def _submit(self, handle: ServerGoalHandle, clients: frozenset[bytes]) -> Future | End:
        """Pass a goal to the control loop; return the future of its end, or the end of an immediate failure."""
        request, following, settings = handle.request, self._following, self._settings
        # An invalid goal is also submitted, since the control loop must end the drive that the goal replaces.
        poses, fault = np.zeros((0, 3)), None
        try:
            poses = path_poses(request.path, settings.follow_most_poses)
        except MessageError as error:
            fault = (Code.INVALID_PATH, str(error))
        if settings.follow_controller_id and request.controller_id not in ("", settings.follow_controller_id):
            reason = f"controller_id is '{request.controller_id}', expected '{settings.follow_controller_id}'"
            fault = (Code.INVALID_CONTROLLER, f"{reason} (parameter follow_controller_id)")
        if following is None:
            return End(GoalOutcome.ABORTED, Code.UNKNOWN, "the node was deactivated")
        header = request.path.header
        goal = FollowGoal(poses, header.frame_id, nanoseconds(header.stamp), fault=fault, clients=clients)
        # The handle stores the request until the result expires. The garbage collection of so many poses would block
        # the control loop for a second.
        request.path = Path()
        future = Future(executor=self._executor)
        self._goals.append((goal, handle, future))
        self._incoming.append((following, goal))
        self._goal_arrived.trigger()
        return future

    def _send_results(self) -> None:
        """Send the results of ended goals to the waiting clients."""
        ended = [entry for entry in self._goals if entry[0].end is not None]
        for entry in ended if self._closing else ended[:_MAX_RESULTS]:
            self._goals.remove(entry)
            entry[2].set_result(entry[0].end)

    def _send_feedback(self) -> None:
        now = time.monotonic()
        alive_goals = self._watch.check([goal.clients for goal, _, _ in self._goals])
        for (goal, _, _), is_alive in zip(self._goals, alive_goals, strict=True):
            goal.missed_checks = 0 if is_alive else goal.missed_checks + 1
            if is_alive:
                goal.alive_at = now
        for goal, handle, _ in self._goals:
            if goal.progress is not None and goal.end is None:
                distance, speed = goal.progress
                feedback = FollowPath.Feedback(distance_to_goal=distance, speed=speed)
                self._watch.send(FollowPath.Impl.FeedbackMessage(goal_id=handle.goal_id, feedback=feedback))

    def _log(self, end: End) -> None:
        log = self._node.get_logger()
        text = f"{ACTION}: {end.outcome}{f' ({end.code.name})' if end.code else ''}: {end.message}"
        # The logger of rclpy requires a constant severity at each call site, hence two calls.
        if end.outcome is GoalOutcome.ABORTED and end.code:
            log.error(text)
        else:
            log.info(text)


def path_poses(message: Path, max_poses: int) -> FloatArray:
    """Extract poses (n, 3) of a path; raise MessageError if they are invalid, too many, or in different frames."""
    frame, count = message.header.frame_id, len(message.poses)
    if count > max_poses:
        raise MessageError(f"the path has {count} poses, the limit is {max_poses} (parameter follow_most_poses)")
    rows = []
    for index, pose in enumerate(message.poses):
        if (pose.header.frame_id or frame) != frame:
            raise MessageError(f"pose {index} is in '{pose.header.frame_id}', the path in '{frame}': use one frame")
        try:
            rows.append(planar_pose(pose.pose))
        except MessageError as error:
            raise MessageError(f"pose {index}: {error}") from error
    return np.array(rows, dtype=float).reshape(-1, 3)
