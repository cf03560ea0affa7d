"""The lifecycle node: parameters, topics and services around the control loop."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.control_loop import Begun, ControlLoop, RefusedError, Tick
from diffdrive_mpc.mpc.ros.diagnostics import diagnostics
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.parameter_changes import ParameterChanges
from diffdrive_mpc.mpc.ros.parameters import declare, fields, from_file_only, read
from diffdrive_mpc.mpc.ros.publishers import Publishers
from diffdrive_mpc.mpc.ros.recording import Recording
from diffdrive_mpc.mpc.ros.reference_input import path_reference, trajectory_reference
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.tick_records import TickRecords
from diffdrive_mpc.mpc.ros.transitions import logged, refuse_what_is_not_allowed
from diffdrive_mpc.mpc.trajectories import Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds
from diffdrive_mpc.mpc.trajectories.spline import SplineTrajectory


class TrackingNode(LifecycleNode):
    """Drives a robot along references with the controller.

    Parameters
    ----------
    defaults
        Defaults of the node's own parameters.
    overrides
        Values of the controller's configuration by dotted key, in place of those of the file.
    **options
        As for `rclpy.node.Node`.

    Attributes
    ----------
    failure
        Why the last transition that failed did; empty if none has.

    Raises
    ------
    models.checked_yaml.ConfigError, rclpy.exceptions.ParameterException
        If the configuration file or an override cannot be used.
    """

    def __init__(
        self,
        defaults: NodeSettings | None = None,
        overrides: dict[str, object] | None = None,
        **options: Any,  # noqa: ANN401 - those of the base class
    ) -> None:
        super().__init__("diffdrive_mpc", **options)
        refuse_what_is_not_allowed(self)
        defaults = defaults or NodeSettings()
        others = tuple(key for key, _ in fields(NodeSettings) if key != "config")
        declare(self, defaults, read_only=True, skip=others)
        declare(self, defaults, skip=("config",))
        config = load_config(self.get_parameter("config").value, overrides)
        declare(self, config)
        self._fixed = from_file_only(config)
        self._changes = ParameterChanges(self, lambda: None if self._loop is None else self._controller, self._fixed)
        self.failure = ""
        self._label = "unconfigured"
        self._controller: Controller | None = None
        self._loop: ControlLoop | None = None
        self._recording: Recording | None = None
        self._timer: Any = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics_timer: Any = None
        self.create_service(Trigger, "~/start", self._serve(lambda loop: loop.start()))
        self.create_service(Trigger, "~/pause", self._serve(lambda loop: loop.pause()))
        self.create_service(Trigger, "~/reset", self._serve(lambda loop: loop.reset()))

    def bring_up(self) -> None:
        """Configure and activate, if the parameter autostart says so; raises ValueError with the reason if it fails."""
        if not self.get_parameter("autostart").value:
            return
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise ValueError(self.failure)

    def stop(self) -> None:
        """Send zero as the last command, if the node is active, and stay silent."""
        if self._loop is None:
            return
        self._loop = None
        gc.unfreeze()
        self.destroy_timer(self._timer)
        self._outgoing.stop(self.get_clock().now().nanoseconds)
        if self._recording is not None:
            self._recording.close()
            self._recording = None

    @logged
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build controller, subscriptions and publishers from the parameters."""
        self._build()
        self._label = "inactive"
        return super().on_configure(state)

    @logged
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to send commands: zero until driving begins."""
        if self._changes.pending:
            self._tear_down()
            self._build()
        answer = super().on_activate(state)
        assert self._controller is not None
        config = self._controller.config
        # Said before the timer starts also because the first words of a logger take 30 ms, more than a tick.
        self.get_logger().info(
            f"active: model {config.model}, {config.horizon} steps of {config.sample_time} s, frame {self._inbox.frame}"
        )
        in_sim_time = bool(self.get_parameter("use_sim_time").value)
        self._controller.reset()
        self._inbox.restart()
        self._loop = ControlLoop(
            self._controller, self._settings, self._inbox, self._trajectory, in_sim_time=in_sim_time
        )
        self._records: TickRecords | None = TickRecords(self._controller)
        if self._settings.record:
            self._recording = self._recorded(config)
        # A full collection walks all that was built, for some 60 ms, three ticks: it is set aside until deactivation.
        gc.collect()
        gc.freeze()
        clock = self.get_clock() if in_sim_time else Clock(clock_type=ClockType.STEADY_TIME)
        period = config.sample_time
        self._timer = self.create_timer(period, self._tick, clock=clock)
        # The constructor cuts off what is less than a nanosecond, and 0.0202 s is a little less than it looks.
        self._period = self._timer.timer_period_ns = round(1e9 * period)
        self._ticks, self._visual_ticks = 0, max(1, round(1.0 / (self._settings.visual_rate * period)))
        self._shown: object = None
        self._label = "active"
        return answer

    @logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero, then no more commands."""
        self.stop()
        self._label = "inactive"
        return super().on_deactivate(state)

    @logged
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop what `on_configure` built."""
        answer = super().on_cleanup(state)
        self._tear_down()
        self._label = "unconfigured"
        return answer

    @logged
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero if active, and drop everything."""
        self.stop()
        answer = super().on_shutdown(state)
        self._tear_down()
        self._label = "finalized"
        return answer

    @logged
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero and be unconfigured."""
        self.stop()
        self._tear_down()
        self._label = "unconfigured"
        return super().on_error(state)

    def _build(self) -> None:
        settings, config = read(self, NodeSettings), read(self, ControllerConfig, fixed=self._fixed)
        trajectory: Trajectory | None = None
        if settings.trajectory:
            trajectory = load_trajectory(settings.trajectory)
            check_speeds(trajectory, config.limits, config.sample_time)
        self._controller = Controller(config)
        self._settings, self._trajectory, self._changes.pending = settings, trajectory, False
        self._inbox = Inbox(settings, lambda: self.get_clock().now().nanoseconds, self.get_clock().now().nanoseconds)
        self._outgoing = Publishers(self, settings, self._inbox.frame)
        sensors, inbox = qos_profile_sensor_data, self._inbox
        self._inputs = [
            self.create_subscription(Odometry, "odom", inbox.take_odometry, sensors),
            self.create_subscription(Path, "set_path", self._take_path, 1),
            self.create_subscription(MultiDOFJointTrajectory, "set_trajectory", self._take_trajectory, 1),
        ]
        if settings.use_imu:
            self._inputs.append(self.create_subscription(Imu, "imu", inbox.take_imu, sensors))
        if settings.use_pose_topic:
            self._inputs.append(self.create_subscription(PoseWithCovarianceStamped, "pose", inbox.take_pose, sensors))
        self._diagnostics_timer = self.create_timer(
            1.0 / settings.diagnostics_rate, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _recorded(self, config: ControllerConfig) -> Recording | None:
        """The recording of this activation; None, with a warning, where none can begin."""
        try:
            return Recording(self._settings, config, self._inbox.frame, self.get_logger())
        except Exception as error:  # a recording is not worth the robot
            self.get_logger().warning(f"nothing is recorded: {error}")
            return None

    def _tear_down(self) -> None:
        if self._controller is None:
            return
        self._controller = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._outgoing.destroy()
        self.destroy_timer(self._diagnostics_timer)

    def _tick(self) -> None:
        loop, outgoing = self._loop, self._outgoing
        if loop is None:
            return
        time = self.get_clock().now().nanoseconds
        tick = loop.tick()
        outgoing.command(tick.command, time)
        outgoing.mode(tick)
        if loop.begun is not None and loop.begun is not self._shown:
            self._shown = loop.begun
            outgoing.reference(loop.begun.reference, time)
            if self._recording is not None:
                self._recording.reference(loop.begun, time)
        if loop.begun is not None and (outgoing.recorded or self._recording is not None):
            self._say(loop.begun, tick, time)
        if tick.result is not None:
            outgoing.error(tick.result, time)
            if self._ticks % self._visual_ticks == 0:
                outgoing.visuals(tick.result, self._period, time)
        self._ticks += 1
        if self._recording is not None:
            self._recording.tick(tick, time, loop.inbox)

    def _say(self, begun: Begun, tick: Tick, time: int) -> None:
        """Say what makes a tick replayable; a fault in that is not worth the robot, and ends it for this activation."""
        if self._records is None:
            return
        try:
            lines = self._records.lines(begun, tick)
            self._outgoing.record(lines)
            if self._recording is not None:
                self._recording.record(lines, time)
        except Exception as error:
            self._records = None
            self.get_logger().warning(f"its ticks cannot be replayed from here on: {type(error).__name__}: {error}")

    def _diagnose(self) -> None:
        time = self.get_clock().now().nanoseconds
        message = diagnostics(self.get_name(), time, self._label, self._loop, self._recording)
        self._diagnostics.publish(message)
        if self._recording is not None:
            self._recording.diagnostics(message, time)

    def _serve(self, request: Callable[[ControlLoop], str]) -> Callable[[Any, Any], Any]:
        """A service that asks the control loop, and answers why not."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                if self._loop is None:
                    raise RefusedError(f"the node is {self._label}; activate it first")
                response.message, response.success = request(self._loop), True
            except ValueError as error:
                response.message, response.success = str(error), False
            self.get_logger().info(response.message)
            return response

        return answer

    def _take_path(self, message: Path) -> None:
        self._offer(lambda config: path_reference(message, self._inbox.frame, config.limits))

    def _take_trajectory(self, message: MultiDOFJointTrajectory) -> None:
        self._offer(lambda config: trajectory_reference(message, self._inbox.frame, config.limits))

    def _offer(self, read_reference: Callable[[ControllerConfig], SplineTrajectory]) -> None:
        """Pass a reference on if it can be used; else say why not and go on as before."""
        if self._loop is None or self._controller is None:
            self.get_logger().error(f"reference refused: the node is {self._label}; activate it first")
            return
        try:
            reference = read_reference(self._controller.config)
            self._loop.offer(reference)
        except ValueError as error:
            self.get_logger().error(f"reference refused: {error}")
        else:
            self.get_logger().info(f"reference accepted: {reference.duration:.1f} s")
