"""Lifecycle node with the parameters, inputs and services of the control loop, and with attached parts."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_srvs.srv import SetBool, Trigger

from diffdrive_mpc.models.logs.drive_log.tick import Cell
from diffdrive_mpc.models.plug_ins import plug_in
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.bond import BondPart
from diffdrive_mpc.mpc.ros.control_loop import ControlLoop, RefusedError
from diffdrive_mpc.mpc.ros.conversions import message_type, subscribe_bounded
from diffdrive_mpc.mpc.ros.diagnostics import diagnostics
from diffdrive_mpc.mpc.ros.follow_part import FollowPathPart
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.node_part import NodePart, NodeTools, PartHost
from diffdrive_mpc.mpc.ros.parameters import (
    ParameterChanges,
    check_overrides,
    declare,
    fields,
    log_failures,
    read,
    reject_forbidden_transitions,
    with_features,
    with_parts,
)
from diffdrive_mpc.mpc.ros.publishers import Publishers
from diffdrive_mpc.mpc.ros.recording import RecordingPart
from diffdrive_mpc.mpc.ros.reference_part import ReferencePart, SpeedLimitPart
from diffdrive_mpc.mpc.ros.rivals import RivalWatch
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.ros.topic_watch import TopicWatch
from diffdrive_mpc.mpc.ros.transform_listener import listen
from diffdrive_mpc.mpc.ros.transforms.frames import Frames
from diffdrive_mpc.mpc.trajectories import Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds

_MAX_JOB_TIME = 10.0
"""Time limit of a job in the side process [s]."""


class TrackingNode(PartHost):
    """Node that drives a robot along references with the controller.

    Parameters
    ----------
    defaults
        Defaults of the node's parameters, except those of the controller.
    overrides
        Values of the controller's configuration by dotted key; they override the file.
    **options
        Options of `rclpy.node.Node`.

    Attributes
    ----------
    failure
        Reason for the last failed transition; empty if no transition has failed.

    Raises
    ------
    models.checked_yaml.ConfigError, rclpy.exceptions.ParameterException
        If the configuration file or an override is invalid.
    models.errors.MissingPackageError
        If the package of a part is not installed.
    """

    def __init__(
        self,
        defaults: NodeSettings | None = None,
        overrides: dict[str, object] | None = None,
        **options: Any,  # noqa: ANN401 - options of the base class
    ) -> None:
        super().__init__("diffdrive_mpc", **options)
        reject_forbidden_transitions(self)
        defaults = defaults or NodeSettings()
        # `config` is declared first, since the file that it names determines the defaults of all other parameters.
        declare(self, defaults, read_only=True, skip=tuple(key for key, _ in fields(defaults) if key != "config"))
        self._declared_config = with_features(self, load_config(self.get_parameter("config").value, overrides))
        self._declared_settings = with_parts(self, defaults, self._declared_config.features)
        declare(self, self._declared_settings, skip=("config",))
        declare(self, self._declared_config)
        check_overrides(self, self._declared_config)
        self._changes = ParameterChanges(
            self,
            self._declared_settings,
            self._declared_config,
            lambda: None if self._loop is None else self._controller,
            lambda: self._call_parts(lambda part: part.change_limits()),
        )
        self.failure = self._shortfall = ""
        self.label = "unconfigured"
        self._controller: Controller | None = None
        self._loop: ControlLoop | None = None
        self._timer: Any = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._resources = ExitStack()
        self.create_service(Trigger, "~/start", self._serve(lambda loop: loop.start()))
        self.create_service(Trigger, "~/pause", self._serve(lambda loop: loop.pause()))
        self.create_service(Trigger, "~/resume", self._serve(lambda loop: loop.resume()))
        self.create_service(Trigger, "~/reset", self._serve(lambda loop: loop.reset()))
        self._is_held = False
        self.create_service(SetBool, "~/hold", self._hold)
        plug_in_types = {
            name: plug_in("node_parts", name)
            for name in self._declared_settings.parts
            if self.get_parameter(f"parts.{name}.enabled").value
        }
        part_types: dict[str, type[NodePart]] = {
            "references": ReferencePart,
            "speed_limit": SpeedLimitPart,
            "follow_path": FollowPathPart,
            "bond": BondPart,
            # Hooks are called in this order. `recording` is last, because other parts add columns to its row.
            **plug_in_types,
            "rivals": RivalWatch,
            "recording": RecordingPart,
        }
        self.parts = {name: part_type(self) for name, part_type in part_types.items()}

    def bring_up(self) -> None:
        """Configure and activate if the parameter autostart is set; raise ValueError with the reason for a failure."""
        if not self.get_parameter("autostart").value:
            self.get_logger().info("unconfigured: configure and activate this lifecycle node, or use --autostart")
            return
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise ValueError(self.failure)

    def brake(self, reason: str) -> float:
        """Brake permanently; return the maximum duration [s]."""
        if self._loop is None:
            return 0.0
        self._loop.brake_permanently(reason)
        return self._settings.shutdown_time

    @property
    def is_moving(self) -> bool:
        """True if the last command was not zero."""
        return self._loop is not None and self._loop.is_moving

    def stop(self) -> None:
        """Send zero as the last command if the node is active."""
        if self._loop is None:
            return
        self._loop = None
        gc.unfreeze()
        self.destroy_timer(self._timer)
        self._outputs.stop(self._now())
        self.deactivate_parts()

    @log_failures
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Build controller, subscriptions and publishers according to the parameters."""
        self._build()
        self.label = "inactive"
        return super().on_configure(state)

    @log_failures
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start the ticks; the transition fails if another node of this project already sends commands."""
        if self._changes.pending or self._controller is None:
            self._tear_down()
            self._build()
        self._call_parts(lambda part: part.check_activation())
        success = super().on_activate(state)
        assert self._controller is not None
        config = self._controller.config
        # Log before the timer starts, since the first log line takes 30 ms, longer than a tick.
        self.get_logger().info(
            f"active: model {config.model}, {config.horizon} steps of {config.sample_time} s, frame {self._inbox.frame}"
        )
        in_sim_time = bool(self.get_parameter("use_sim_time").value)
        self._controller.reset()
        self._inbox.restart()
        self._loop = ControlLoop(
            self._controller, self._settings, self._inbox, self._trajectory, in_sim_time=in_sim_time, held=self._is_held
        )
        self.activate_parts(self._loop)
        # A full garbage collection takes about 60 ms (three ticks), so it excludes existing objects until deactivation.
        gc.collect()
        gc.freeze()
        clock = self.get_clock() if in_sim_time else Clock(clock_type=ClockType.STEADY_TIME)
        period = config.sample_time
        # The executor handles timers before subscriptions. In simulated time, many messages arrive with a clock step;
        # the guard condition delays the tick until earlier sensor messages are processed.
        self._timer = self.create_timer(period, self._tick_trigger.trigger if in_sim_time else self._tick, clock=clock)
        # The constructor truncates the period to nanoseconds, which loses 1 ns for a period such as 0.0202 s.
        self._period = self._timer.timer_period_ns = round(1e9 * period)
        self._ticks, self._visual_ticks = 0, max(1, round(1.0 / (self._settings.visual_rate * period)))
        self.label = "active"
        return success

    @log_failures
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero as the last command."""
        self.stop()
        self.label = "inactive"
        return super().on_deactivate(state)

    @log_failures
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy the objects that `on_configure` built."""
        success = super().on_cleanup(state)
        self._tear_down()
        self.label = "unconfigured"
        return success

    @log_failures
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero if the node is active, and destroy all objects."""
        self.stop()
        success = super().on_shutdown(state)
        self._tear_down()
        self.label = "finalized"
        return success

    @log_failures
    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero and return to the unconfigured state."""
        self.stop()
        self._tear_down()
        self.label = "unconfigured"
        return super().on_error(state)

    def destroy_node(self) -> None:
        """Send zero if the node is active, and destroy all objects."""
        self.stop()
        self._tear_down()
        super().destroy_node()

    def _call_parts(self, hook: Callable[[NodePart], object]) -> None:
        for part in self.parts.values():
            hook(part)

    def _build(self) -> None:
        """Build the objects that exist from configuration to cleanup; destroy them if a step raises an error."""
        settings, config = read(self, self._declared_settings), read(self, self._declared_config)
        trajectory: Trajectory | None = None
        if settings.trajectory:
            trajectory = load_trajectory(settings.trajectory, config)
            check_speeds(trajectory, config.limits, config.sample_time)
            if trajectory.remark:
                self.get_logger().info(trajectory.remark)
        controller = Controller(config)
        # If a step raises an error, the stack destroys the existing objects; otherwise `pop_all` keeps them.
        with ExitStack() as resources:
            uses_tf = settings.use_tf or settings.poses_from == "tf"
            frames = Frames(settings.control_frame, settings.base_frame, settings.tf_timeout, self._now)
            if uses_tf or (settings.use_imu and message_type("tf2_msgs", "TFMessage")):
                for subscription in listen(self, frames, moving=uses_tf):
                    resources.callback(self.destroy_subscription, subscription)
            self._inbox = Inbox(settings, self._now, self._now(), frames if uses_tf else None)
            # A negative sign in the configuration describes the mount of the gyro, which replaces its transforms.
            self._inbox.mounts = frames.buffer if config.sensors.yaw_rate.sign > 0 else None
            self._outputs = Publishers(self, settings, lambda: controller.config, self._inbox.frame)
            resources.callback(self._outputs.destroy)
            inputs: list[tuple[TopicWatch, Subscription]] = []
            for kind, topic, callback, watch in self._input_topics(self._inbox, settings):
                subscription = subscribe_bounded(
                    self, kind, topic, callback, qos_profile_sensor_data, refuse=watch.refuse, series=watch.series
                )
                resources.callback(self.destroy_subscription, subscription)
                inputs.append((watch, subscription))
            has_results = self.create_guard_condition(lambda: None)
            resources.callback(self.destroy_guard_condition, has_results)
            # Results are delivered in the executor's thread, which the guard condition wakes.
            self._worker = SideProcess(has_results.trigger, _MAX_JOB_TIME)
            resources.callback(self._worker.close)
            has_results.callback = self._worker.deliver
            self._tick_trigger = self.create_guard_condition(self._tick)
            resources.callback(self.destroy_guard_condition, self._tick_trigger)
            resources.callback(self.tear_down_parts)
            self.configure_parts(NodeTools(settings, controller, self._inbox, self._outputs, self._worker, inputs))
            diagnostics_timer = self.create_timer(
                1.0 / settings.diagnostics_rate, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME)
            )
            resources.callback(self.destroy_timer, diagnostics_timer)
            self._resources = resources.pop_all()
        self._controller = controller
        self._settings, self._trajectory, self._changes.pending = settings, trajectory, False

    @staticmethod
    def _input_topics(
        inbox: Inbox, settings: NodeSettings
    ) -> Iterator[tuple[type[Any], str, Callable[[Any], None], TopicWatch]]:
        """Yield message type, topic, callback and watch of each input of the controller."""
        yield Odometry, "odom", inbox.receive_odometry, inbox.odometry
        if settings.use_imu:
            yield Imu, "imu", inbox.receive_imu, inbox.imu
        if settings.poses_from == "topic":
            yield PoseWithCovarianceStamped, "pose", inbox.receive_pose, inbox.pose

    def _now(self) -> int:
        """Return the node's time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def _tear_down(self) -> None:
        self._controller = None
        self._resources.close()

    def _tick(self) -> None:
        loop, outputs = self._loop, self._outputs
        if loop is None:
            return
        time = self._now()
        tick = loop.tick()
        self._call_parts(lambda part: part.tick(tick))
        # The command is sent first, so that all other work does not delay it.
        outputs.command(tick.command, time)
        update = loop.reference_to_publish()
        if update is not None:
            # The monitor must receive the reference before the mode TRACKING.
            outputs.reference(update.reference, loop.inbox.stamp_of(update.t0), time)
        outputs.mode(tick)
        if tick.result is not None:
            outputs.error(tick.result, time)
            if self._ticks % self._visual_ticks == 0:
                outputs.visuals(tick.result, self._period, time)
        self._ticks += 1
        row: dict[str, Cell] = {}
        self._call_parts(lambda part: part.after_tick(tick, time, row))

    def _diagnose(self) -> None:
        time = self._now()
        name = self.get_fully_qualified_name().lstrip("/")
        message = diagnostics(name, time, self.label, self._loop, self.parts.values())
        self._diagnostics.publish(message)
        previous, self._shortfall = self._shortfall, "" if self._loop is None else self._loop.shortfall
        if self._shortfall and self._shortfall != previous:
            self.get_logger().warning(self._shortfall)
        self._call_parts(lambda part: part.after_diagnostics(message, time))

    def _serve(self, request: Callable[[ControlLoop], str]) -> Callable[[Any, Any], Any]:
        """Return a service callback that calls `request` with the control loop and returns its result or error."""

        def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                if self._loop is None:
                    raise RefusedError(f"the node is {self.label}; activate it first")
                response.message, response.success = request(self._loop), True
            except ValueError as error:
                response.message, response.success = str(error), False
            self.get_logger().info(response.message)
            return response

        return serve

    def _hold(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Hold or release the robot; a hold persists across deactivation."""
        self._is_held = bool(request.data)
        if self._loop is None:
            outcome = "is held after its activation" if self._is_held else "is not held"
        else:
            outcome = self._loop.hold(on=self._is_held)
        response.success, response.message = True, outcome
        self.get_logger().info(f"hold: {outcome}")
        return response
