"""The lifecycle node: parameters, topics and services around the control loop."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import BatteryState, Imu, PointCloud2
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.config.schema import ControllerConfig, Limits
from diffdrive_mpc.mpc.controller import Controller
from diffdrive_mpc.mpc.ros.bond import Bond
from diffdrive_mpc.mpc.ros.command_output import command_topic
from diffdrive_mpc.mpc.ros.control_loop import Begun, ControlLoop, LoopTick, RefusedError
from diffdrive_mpc.mpc.ros.conversions import BATTERY_BYTES, check_frame, message_type, subscribe_bounded, too_long
from diffdrive_mpc.mpc.ros.diagnostics import diagnostics
from diffdrive_mpc.mpc.ros.follow_goal import Following, FrameError, lay_for_robot
from diffdrive_mpc.mpc.ros.inbox import Inbox
from diffdrive_mpc.mpc.ros.parameters import (
    ParameterChanges,
    declare,
    fields,
    from_file_only,
    logged,
    read,
    refuse_what_is_not_allowed,
)
from diffdrive_mpc.mpc.ros.publishers import Publishers, deaf_to_commands, publishers_of
from diffdrive_mpc.mpc.ros.recording import ActivationRecording, TickRecords
from diffdrive_mpc.mpc.ros.reference_input import (
    MOST_BYTES,
    MOST_TRAJECTORY_BYTES,
    SpeedLimit,
    StatedReference,
    nothing,
    read_path,
    read_speed_limit,
    read_timed_trajectory,
    read_trajectory,
    timed_trajectory_type,
)
from diffdrive_mpc.mpc.ros.rivals import Others, Rivals, drive_too, publish_too, speak_together
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.mpc.ros.transform_listener import listen
from diffdrive_mpc.mpc.ros.transforms.buffer import TransformError
from diffdrive_mpc.mpc.ros.transforms.frames import Frames, Placement, moved_poses
from diffdrive_mpc.mpc.trajectories import Trajectory, load_trajectory
from diffdrive_mpc.mpc.trajectories.planned.lay import Laid
from diffdrive_mpc.mpc.trajectories.speed_check import check_speeds
from diffdrive_mpc_extras.ros.drive_energy import DriveEnergy
from diffdrive_mpc_extras.ros.path_error import ErrorPredictor
from diffdrive_mpc_extras.ros.surroundings_input import SurroundingsInput
from diffdrive_mpc_extras.turn_costs import TurnCosts, load_turn_costs

if TYPE_CHECKING:
    from diffdrive_mpc.mpc.ros.follow_path import FollowPathServer

# How often to look for others that publish commands [s].
_LOOK_AROUND = 0.2
_REFERENCES = "set_path", "set_trajectory", "set_timed_trajectory"
# To read a reference may take so long [s]: what takes longer than this is none.
_LONGEST_READING = 10.0


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
        self._changes = ParameterChanges(
            self, lambda: None if self._loop is None else self._controller, self._fixed, self._limit_speed
        )
        self.failure = ""
        self._label = "unconfigured"
        self._controller: Controller | None = None
        self._loop: ControlLoop | None = None
        self._recording: ActivationRecording | None = None
        self._bond: Bond | None = None
        self._timer: Any = None
        self._door: FollowPathServer | None = None
        self._following: Following | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics_timer: Any = None
        self.create_service(Trigger, "~/start", self._serve(lambda loop: loop.start()))
        self.create_service(Trigger, "~/pause", self._serve(lambda loop: loop.pause()))
        self.create_service(Trigger, "~/reset", self._serve(lambda loop: loop.reset()))
        self._held = False
        # A limit of a zone, too, outlasts the node's being inactive: the zone does.
        self._speed_limit: SpeedLimit | None = None
        self.create_service(SetBool, "~/hold", self._hold)
        self._predictor: ErrorPredictor | None = None
        # Why there is none.
        self._unpredictable = ""
        self._awaited: set[Future] = set()
        # A group of its own: while its answer is awaited, the tick is not.
        group = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/predict_error", self._predict_error, callback_group=group)

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
        if self._door is not None:
            self._door.shut("the node was deactivated")
        self._following = None
        gc.unfreeze()
        self.destroy_timer(self._timer)
        self.destroy_timer(self._rivals_timer)
        self._outgoing.stop(self.get_clock().now().nanoseconds)
        self._rivals.release()
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
        """Begin to send commands, zero until driving begins, unless another node of this project does so already."""
        if self._changes.pending:
            self._tear_down()
            self._build()
        others = self._rivals.claim(self._settings.discovery_wait)
        objection = self._objection(others)
        if objection:
            self._rivals.release()
            raise RefusedError(objection)
        answer = super().on_activate(state)
        assert self._controller is not None
        config = self._controller.config
        # Said before the timer starts also because the first words of a logger take 30 ms, more than a tick.
        self.get_logger().info(
            f"active: model {config.model}, {config.horizon} steps of {config.sample_time} s, frame {self._inbox.frame}"
        )
        in_sim_time = bool(self.get_parameter("use_sim_time").value)
        self._controller.reset()
        self._limit_speed()
        self._inbox.restart()
        if self._surroundings is not None:
            self._surroundings.restart()
        if self._energy is not None:
            self._energy.restart()
        self._loop = ControlLoop(
            self._controller, self._settings, self._inbox, self._trajectory, in_sim_time=in_sim_time, held=self._held
        )
        if self._door is not None:
            self._following = self._followed(self._loop, self._controller)
            self._door.open(self._following)
        self._look_around()
        self._rivals_timer = self.create_timer(
            _LOOK_AROUND, self._look_around, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._records: TickRecords | None = TickRecords(self._controller)
        if self._settings.record:
            self._recording = self._recorded(config)
        # A full collection walks all that was built, for some 60 ms, three ticks: it is set aside until deactivation.
        gc.collect()
        gc.freeze()
        clock = self.get_clock() if in_sim_time else Clock(clock_type=ClockType.STEADY_TIME)
        period = config.sample_time
        # The executor serves timers first: where the clock brings many messages at once, the tick waits its turn
        # behind the sensors that came before it.
        self._timer = self.create_timer(period, self._due.trigger if in_sim_time else self._tick, clock=clock)
        # The constructor cuts off what is less than a nanosecond, and 0.0202 s is a little less than it looks.
        self._period = self._timer.timer_period_ns = round(1e9 * period)
        self._ticks, self._visual_ticks = 0, max(1, round(1.0 / (self._settings.visual_rate * period)))
        self._shown: object = None
        self._label = "active"
        self._bind()
        return answer

    @logged
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Send zero, then no more commands."""
        self.stop()
        if self._bond is not None:
            self._bond.leave()
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
        if (settings.use_costmap or settings.use_obstacles) and not config.free_space.enabled:
            raise RefusedError("use_costmap or use_obstacles is set: set free_space.enabled, too")
        costs = load_turn_costs(config.energy.turn_costs) if config.energy.turn_costs else None
        trajectory: Trajectory | None = None
        if settings.trajectory:
            trajectory = load_trajectory(settings.trajectory, config)
            check_speeds(trajectory, config.limits, config.sample_time)
        controller = Controller(config)
        self._predictor = self._error_predictor(controller, settings)
        self._controller = controller
        self._settings, self._trajectory, self._changes.pending = settings, trajectory, False
        self._frames: Frames | None = None
        hears: list[Subscription] = []
        if settings.use_tf or settings.poses_from == "tf":
            self._frames = Frames(settings.control_frame, settings.base_frame, settings.tf_timeout, self._now)
            hears = listen(self, self._frames)
        self._inbox = Inbox(settings, self._now, self._now(), self._frames)
        self._outgoing = Publishers(self, settings, lambda: controller.config, self._inbox.frame)
        self._rivals = Rivals(self, command_topic(settings))
        sensors, inbox = qos_profile_sensor_data, self._inbox
        self._inputs = [
            subscribe_bounded(self, Odometry, "odom", inbox.take_odometry, sensors, refuse=inbox.odometry.refuse),
            self.create_subscription(Path, _REFERENCES[0], self._reads(read_path), 1, raw=True),
            self.create_subscription(
                MultiDOFJointTrajectory, _REFERENCES[1], self._reads(read_trajectory), 1, raw=True
            ),
        ]
        self._watched = [(inbox.odometry, self._inputs[0])]
        if settings.use_imu:
            self._inputs.append(subscribe_bounded(self, Imu, "imu", inbox.take_imu, sensors, refuse=inbox.imu.refuse))
            self._watched.append((inbox.imu, self._inputs[-1]))
        if settings.poses_from == "topic":
            kind = PoseWithCovarianceStamped
            self._inputs.append(
                subscribe_bounded(self, kind, "pose", inbox.take_pose, sensors, refuse=inbox.pose.refuse)
            )
            self._watched.append((inbox.pose, self._inputs[-1]))
        self._inputs += [*hears, *self._optional_inputs()]
        self._energy = self._energy_of(settings, costs, config.sample_time)
        self._read = self.create_guard_condition(lambda: None)
        self._aside = SideProcess(self._read.trigger, _LONGEST_READING)
        self._read.callback = self._aside.deliver
        self._due = self.create_guard_condition(self._tick)
        self._surroundings = self._see_around(settings, self._controller)
        self._door = self._follow_path(settings)
        self._diagnostics_timer = self.create_timer(
            1.0 / settings.diagnostics_rate, self._diagnose, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _energy_of(self, settings: NodeSettings, costs: TurnCosts | None, sample_time: float) -> DriveEnergy | None:
        """What counts power and energy; None where neither turn costs nor the battery are asked for."""
        if costs is None and not settings.use_battery:
            return None
        energy, sensors = DriveEnergy(settings, costs, self._inbox, sample_time), qos_profile_sensor_data
        if settings.use_battery:
            take, refuse = energy.take_battery, energy.battery.refuse
            self._inputs.append(
                subscribe_bounded(self, BatteryState, "battery_state", take, sensors, refuse=refuse, most=BATTERY_BYTES)
            )
        return energy

    def _see_around(self, settings: NodeSettings, controller: Controller) -> SurroundingsInput | None:
        """What hears of surroundings; None where no topic of them is used."""
        if not (settings.use_costmap or settings.use_obstacles):
            return None
        surroundings = SurroundingsInput(settings, controller, self._inbox, self._aside, self.get_logger().warning)
        if settings.use_costmap:
            self._inputs.append(
                self.create_subscription(OccupancyGrid, "costmap", surroundings.take_costmap, 1, raw=True)
            )
        if settings.use_obstacles:
            take, sensors = surroundings.take_obstacles, qos_profile_sensor_data
            self._inputs.append(self.create_subscription(PointCloud2, "obstacles", take, sensors, raw=True))
        self._aside.prepare(nothing)
        return surroundings

    def _now(self) -> int:
        """The node's time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def _bind(self) -> None:
        """Begin a bond with the lifecycle manager, where its type is installed."""
        self._unbind()
        if not self._settings.bond_heartbeat_period:
            return
        if message_type("bond", "Status") is None:
            self.get_logger().info("no bond with a lifecycle manager: bond is not installed; set its bond_timeout to 0")
            return
        self._bond = Bond(self, self._settings.bond_heartbeat_period)

    def _unbind(self) -> None:
        if self._bond is not None:
            self._bond.close()
            self._bond = None

    def _follow_path(self, settings: NodeSettings) -> FollowPathServer | None:
        """The action server; None, with a word, where it is not wanted or its type is not there."""
        if not settings.follow_path:
            return None
        try:
            from diffdrive_mpc.mpc.ros.follow_path import FollowPathServer  # noqa: PLC0415 - needs nav2_msgs
        except ImportError as error:
            self.get_logger().info(f"no action follow_path: {error} (it needs nav2_msgs)")
            return None
        return FollowPathServer(self, settings)

    def _followed(self, loop: ControlLoop, controller: Controller) -> Following:
        def lay(arguments: tuple[object, ...], done: Callable[[Laid], None], failed: Callable[[str], None]) -> None:
            self._aside.submit("follow_path", lay_for_robot, arguments, done, failed)

        self._aside.prepare(nothing)
        settings, config = self._settings, lambda: controller.config
        predictor = self._predictor if settings.follow_error_limit else None
        return Following(
            loop, settings, config, lambda: controller.model.dc_gain, lay, self._in_control_frame, predictor
        )

    def _in_control_frame(self, poses: FloatArray, frame: str, stamp: int) -> FloatArray:
        """Poses (n, 3) in the frame of control, as they lie now; raises FrameError where they cannot be brought there.

        They stay there: whoever plans on sends a newer path where a localisation has corrected itself.
        """
        if self._frames is None and frame != self._inbox.frame:
            raise FrameError(
                f"the path is in '{frame}', control in '{self._inbox.frame}': plan in that frame, or set use_tf"
            )
        try:
            placement = None if self._frames is None else self._frames.placement(frame, stamp)
            return poses if placement is None else moved_poses(poses, placement.motion())
        except TransformError as error:
            raise FrameError(str(error)) from error

    def _objection(self, others: Others) -> str:
        """Why the robot must not be driven beside `others`; empty where it may."""
        objection = drive_too(others, self._rivals.topic)
        if not objection and others.foreign and self._settings.exclusive_cmd_vel:
            objection = f"{publish_too(others, self._rivals.topic)}; stop that, or set exclusive_cmd_vel to false"
        if not objection and self._settings.exclusive_inputs:
            objection = self._voices()
        return objection

    def _voices(self) -> str:
        """Which input has more than one voice."""
        return speak_together(self, (subscription.topic_name for _, subscription in self._watched))

    def _look_around(self) -> None:
        """Tell the loop who else publishes commands, which makes it brake or is named, and who does not hear it."""
        loop, others = self._loop, self._rivals.others()
        if loop is None:
            return
        before = loop.objection, loop.warning
        loop.objection = self._objection(others)
        topic = self._rivals.topic
        warnings = (
            "" if loop.objection else publish_too(others, topic),
            # Where inputs are exclusive the objection has looked already.
            "" if loop.objection or self._settings.exclusive_inputs else self._voices(),
            deaf_to_commands(self, topic, stamped=self._settings.stamped),
            self._out_of_step(loop),
        )
        loop.warning = "; ".join(filter(None, warnings))
        if (loop.objection, loop.warning) != before and (loop.objection or loop.warning):
            self.get_logger().warning("; ".join(filter(None, (loop.objection, loop.warning))))
        for watch, subscription in self._watched:
            watch.source = "" if watch.accepted else publishers_of(self, subscription)

    def _out_of_step(self, loop: ControlLoop) -> str:
        """Say that the simulated clock does not advance in steps of the period; empty where it does, or on a robot."""
        if not (self.get_parameter("use_sim_time").value and loop.times.out_of_step):
            return ""
        return (
            f"the simulated clock does not advance in steps of this node's sample_time, {1e-6 * self._period:.4g} ms: "
            "start the simulated robot with the same configuration (robot --config FILE)"
        )

    def _optional_inputs(self) -> list[Subscription]:
        """Those whose types not every installation has."""
        timed: list[Subscription] = []
        if (kind := timed_trajectory_type()) is not None:
            take = self._reads(read_timed_trajectory, MOST_TRAJECTORY_BYTES)
            timed = [self.create_subscription(kind, _REFERENCES[2], take, 1, raw=True)]
        if not self._settings.use_speed_limit:
            return timed
        kind = message_type("nav2_msgs", "SpeedLimit")
        if kind is None:
            self.get_logger().info("speed_limit is not heard: nav2_msgs is not installed")
            return timed
        refuse = self._refuse_speed_limit
        return [*timed, subscribe_bounded(self, kind, "speed_limit", self._take_speed_limit, 10, refuse=refuse)]

    def _take_speed_limit(self, message: Any) -> None:  # noqa: ANN401 - ROS messages have no types to check
        try:
            limit = read_speed_limit(message)
        except ValueError as error:
            self._refuse_speed_limit(str(error))
            return
        if limit != self._speed_limit:
            self._speed_limit = limit
            self._limit_speed()

    def _refuse_speed_limit(self, reason: str) -> None:
        self.get_logger().error(f"speed limit refused, the last one stays: {reason}")

    def _limit_speed(self) -> None:
        """Have the controller keep to the limit as it stands, by the greatest speed of its configuration."""
        if self._controller is None or self._speed_limit is None:
            return
        before = self._controller.speed_limit
        wanted = self._speed_limit.speed(self.get_parameter("limits.v").value)
        if wanted != before:
            self._controller.limit_speed(wanted)
            self.get_logger().info("speed limit off" if wanted is None else f"speed limit {wanted:.3g} m/s")

    def _recorded(self, config: ControllerConfig) -> ActivationRecording | None:
        """The recording of this activation; None, with a warning, where none can begin."""
        try:
            # Two robots that are activated in the same second must not write one file.
            folder = self._settings.record_folder + self.get_namespace().rstrip("/")
            settings = self._settings.model_copy(update={"record_folder": folder})
            return ActivationRecording(settings, config, self._inbox.frame, self.get_logger())
        except Exception as error:  # a recording is not worth the robot
            self.get_logger().warning(f"nothing is recorded: {error}")
            return None

    def _tear_down(self) -> None:
        if self._controller is None:
            return
        self._unbind()
        self._controller = None
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._rivals.release()
        if self._door is not None:
            self._door.close()
            self._door = None
        self._outgoing.destroy()
        self.destroy_timer(self._diagnostics_timer)
        self._aside.close()
        for answer in self._awaited:
            answer.set_result((False, "the node was deactivated and cleaned up"))
        self.destroy_guard_condition(self._read)
        self.destroy_guard_condition(self._due)

    def _tick(self) -> None:
        loop, outgoing = self._loop, self._outgoing
        if loop is None:
            return
        time = self.get_clock().now().nanoseconds
        tick = loop.tick()
        if self._following is not None:
            self._following.after(tick)
        outgoing.command(tick.command, time)
        due = loop.due()
        if due is not None:
            # Before the mode: the monitor has to know where the robot goes before it hears that it drives on.
            outgoing.reference(due.reference, loop.inbox.stamp_of(due.t0), time)
        outgoing.mode(tick)
        if loop.begun is not None and loop.begun is not self._shown:
            self._shown = loop.begun
            if self._recording is not None:
                self._recording.reference(loop.begun, time)
        if loop.begun is not None and (outgoing.recorded or self._recording is not None):
            self._say(loop.begun, tick, time)
        if tick.result is not None:
            outgoing.error(tick.result, time)
            if self._ticks % self._visual_ticks == 0:
                outgoing.visuals(tick.result, self._period, time)
        self._ticks += 1
        heard = {} if self._energy is None else self._energy.tick(tick.command, loop.begun)
        if self._recording is not None:
            self._recording.tick(tick, time, loop.inbox, heard)

    def _say(self, begun: Begun, tick: LoopTick, time: int) -> None:
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

    def destroy_node(self) -> None:
        """Send zero if active, and drop everything."""
        self.stop()
        self._tear_down()
        super().destroy_node()

    def _diagnose(self) -> None:
        if self._loop is not None and any(self.count_publishers(topic) for topic in _REFERENCES):
            self._aside.prepare(nothing)
        time = self.get_clock().now().nanoseconds
        topics = () if self._surroundings is None else self._surroundings.topics
        message = diagnostics(
            self.get_fully_qualified_name().lstrip("/"),
            time,
            self._label,
            self._loop,
            self._recording,
            self._bond,
            topics,
            self._energy,
        )
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

    def _error_predictor(self, controller: Controller, settings: NodeSettings) -> ErrorPredictor | None:
        """Predicts errors; None for a model that none is predicted for, unless paths have to keep to a limit."""
        try:
            self._unpredictable = ""
            return ErrorPredictor.of(controller, settings)
        except ConfigError:
            raise
        except ValueError as error:
            if settings.follow_error_limit:
                raise RefusedError(f"follow_error_limit is set, and {error}") from error
            self._unpredictable = str(error)
            return None

    async def _predict_error(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Predict the error of the reference that is driven, or would be, beside the loop."""
        try:
            if self._loop is None or self._controller is None:
                raise RefusedError(f"the node is {self._label}; activate it first")
            if self._predictor is None:
                raise RefusedError(self._unpredictable)
            if self._loop.reference is None:
                raise RefusedError("there is no reference yet; send one, or set the parameter trajectory")
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        answer = Future()
        self._awaited.add(answer)
        arguments = self._predictor, self._loop.reference, self._controller.config
        self._aside.submit(
            "predict_error",
            ErrorPredictor.summary,
            arguments,
            lambda words: answer.set_result((True, words)),
            lambda why: answer.set_result((False, why)),
        )
        response.success, response.message = await answer
        self._awaited.discard(answer)
        return response

    def _hold(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Kept here, too: whoever stopped the robot did not mean until the next activation."""
        self._held = bool(request.data)
        if self._loop is None:
            answer = "is held once it is active" if self._held else "is not held"
        else:
            answer = self._loop.hold(on=self._held)
        response.success, response.message = True, answer
        self.get_logger().info(f"hold: {answer}")
        return response

    def _reads(
        self, read_reference: Callable[[bytes, Limits], StatedReference], most: int = MOST_BYTES
    ) -> Callable[[bytes], None]:
        """A subscription's callback that has references read beside the loop, where they are not too long for it."""

        def take(raw: bytes) -> None:
            if self._loop is None or self._controller is None:
                self._refuse(f"the node is {self._label}; activate it first")
            elif len(raw) > most:
                self._refuse(too_long(len(raw), most))
            else:
                loop, limits = self._loop, self._controller.config.limits
                self._aside.submit(
                    "reference", read_reference, (raw, limits), lambda stated: self._offer(loop, stated), self._refuse
                )

        return take

    def _refuse(self, reason: str) -> None:
        self.get_logger().error(f"reference refused: {reason}")

    def _offer(self, loop: ControlLoop, stated: StatedReference) -> None:
        """Pass a reference on if it can be used; else say why not and go on as before."""
        try:
            if loop is not self._loop:
                raise RefusedError("the node was deactivated while it was read")
            loop.offer(stated.reference, self._placement(stated.frame, stated.stamp))
        except ValueError as error:
            self._refuse(str(error))
        else:
            self.get_logger().info(f"reference accepted: {stated.reference.duration:.1f} s")

    def _placement(self, frame: str, stamp: int) -> Placement | None:
        """Where a reference lies that is stated in `frame` at `stamp` [ns]; raises ValueError where that is unknown."""
        if self._frames is not None:
            return self._frames.placement(frame, stamp)
        parameter = "odom_frame, or map_frame with use_pose_topic; with use_tf it may be any that /tf knows"
        check_frame(frame, self._inbox.frame, parameter)
        return None
