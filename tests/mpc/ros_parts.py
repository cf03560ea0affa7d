"""Simulated base that runs in lock step with the tested node, over DDS in one thread."""

import os
import tempfile
import time
from contextlib import ExitStack, contextmanager

import numpy as np
from ros_domain import own_domain

os.environ["ROS_DOMAIN_ID"] = own_domain()
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="ros-log-"))

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from diffdrive_mpc.mpc.config.config_file import load_config
from diffdrive_mpc.mpc.ros import node as node_module
from diffdrive_mpc.mpc.ros.conversions import nanoseconds, pose_message, time_message
from diffdrive_mpc.mpc.ros.node import TrackingNode
from diffdrive_mpc.mpc.ros.side_process import SideProcess
from diffdrive_mpc.sim import make_plant

CONFIG = load_config("ssm")
DT = CONFIG.sample_time
PERIOD = round(DT * 1e9)
START = 10**9
# Timeout of a step of a test; only faults exceed it [s].
PATIENCE = 60.0
# Time limit of the discovery of a service, which usually takes less than 0.1 s [s].
DISCOVERY = 20.0


class KeptProcess(SideProcess):
    """Side process that the next node reuses, so that the next test does not start Python again."""

    _spare = None
    _busy = False

    def _start_process(self):
        process_and_link, KeptProcess._spare = KeptProcess._spare, None
        if process_and_link is None or process_and_link[0].poll() is not None:
            return super()._start_process()
        self._process, self._link = process_and_link
        return self._link

    def _run_job(self, job):
        self._busy = True
        response = super()._run_job(job)
        self._busy = False
        return response

    def close(self):
        with self._condition:
            if self._link is not None and not self._busy and KeptProcess._spare is None:
                KeptProcess._spare, self._process, self._link = (self._process, self._link), None, None
        super().close()


node_module.SideProcess = KeptProcess


def in_name_space(name):
    """Return ROS arguments of a robot in the name space `name` with its own clock; an empty list without a name."""
    return ["--ros-args", "-r", f"__ns:=/{name}", "-r", f"/clock:=/{name}/clock"] if name else []


class FakeBase:
    """Velocity model with perfect sensors; `tamper` may change or drop each odometry message."""

    def __init__(self, spin, plant="model:ssm+0.005", *, stamped=True, pose_topic=False, name_space=""):
        self.context = Context()
        rclpy.init(context=self.context, args=in_name_space(name_space))
        self.frames = f"{name_space}/" if name_space else ""
        self.node = rclpy.create_node("fake_base", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.spin_node = spin
        self.stamped, self.pose_topic = stamped, pose_topic
        self.odom = self.node.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self.imu = self.node.create_publisher(Imu, "imu", qos_profile_sensor_data)
        self.pose = self.node.create_publisher(PoseWithCovarianceStamped, "pose", qos_profile_sensor_data)
        self.clock = self.node.create_publisher(Clock, "/clock", 1)
        kind = TwistStamped if stamped else Twist
        self.node.create_subscription(kind, "cmd_vel", self._take, QoSProfile(depth=1))
        self.plant = make_plant(plant, surface="ideal", sensors="perfect")
        self.plant.reset((0.0, 0.0, 0.0))
        self.tick = 0
        self.commands = []
        self.times = []
        self.tamper = lambda odometry: odometry
        self.held = False
        self.ahead = 0  # offset of sensor stamps into the future [ns]
        self.gyro = True

    @property
    def now(self):
        return START + self.tick * PERIOD

    def _take(self, message):
        twist = message.twist if self.stamped else message
        self.commands.append((twist.linear.x, twist.angular.z))
        self.times.append(nanoseconds(message.header.stamp) if self.stamped else self.now)

    def spin(self):
        self.executor.spin_once(timeout_sec=0.0)
        self.spin_node()

    def until(self, condition, awaited):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, f"timed out waiting for {awaited}"
            self.spin()

    def publish_sensors(self):
        measurement = self.plant.measure()
        odometry = Odometry(child_frame_id=f"{self.frames}base_link")
        odometry.header.stamp, odometry.header.frame_id = time_message(self.now + self.ahead), f"{self.frames}odom"
        odometry.pose.pose = pose_message(measurement.pose.value)
        odometry.twist.twist.linear.x, odometry.twist.twist.angular.z = map(float, measurement.wheel_twist.value)
        odometry = self.tamper(odometry)
        if odometry is not None:
            self.odom.publish(odometry)
        if self.gyro:
            self.publish_imu(measurement.yaw_rate.value)
        if self.pose_topic:
            pose = PoseWithCovarianceStamped()
            pose.header.stamp, pose.header.frame_id = time_message(self.now + self.ahead), "map"
            pose.pose.pose = pose_message(measurement.pose.value)
            self.pose.publish(pose)

    def publish_imu(self, yaw_rate):
        imu = Imu()
        imu.header.stamp, imu.header.frame_id = time_message(self.now + self.ahead), "base_link"
        imu.angular_velocity.z = float(yaw_rate)
        self.imu.publish(imu)

    def advance_clock(self):
        """Publish sensors and clock of the next tick."""
        self.tick += 1
        self.publish_sensors()
        self.clock.publish(Clock(clock=time_message(self.now)))

    def step(self):
        """Run one tick in lock step: sensors, clock, command, motion."""
        count = len(self.commands)
        self.advance_clock()
        self.until(lambda: len(self.commands) > count and self.times[-1] == self.now, f"command of tick {self.tick}")
        self.plant.advance((0.0, 0.0) if self.held else self.commands[-1])
        return np.array(self.commands[-1])

    def run(self, ticks):
        """Run several ticks; return the commands (ticks, 2)."""
        return np.array([self.step() for _ in range(ticks)])

    def silent(self, ticks):
        """Run ticks that the node must not respond to; return the number of commands."""
        count = len(self.commands)
        for _ in range(ticks):
            self.advance_clock()
            for _ in range(10):
                self.spin()
            self.plant.advance((0.0, 0.0))
        return len(self.commands) - count

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class WallClockBase(FakeBase):
    """Base in approximately real time, which does not wait for commands and publishes no clock."""

    _moved = 0

    @property
    def now(self):
        return self.node.get_clock().now().nanoseconds

    def spin(self):
        """Move and publish the sensors when a sample is due, also while a test waits for a service."""
        if self.now >= self._moved + PERIOD:
            self._moved = self.now
            self.plant.advance(self.commands[-1] if self.commands else (0.0, 0.0))
            self.publish_sensors()
        super().spin()

    def advance_clock(self):
        time.sleep(DT)


class Stack:
    """Node in a separate context and its base; with `drive`, the node has accepted a call of `start`."""

    def __init__(
        self,
        overrides=None,
        *,
        plant="model:ssm+0.005",
        pose_topic=False,
        drive=False,
        sim_time=True,
        name_space="",
        files=(),
        **parameters,
    ):
        parameters = {"autostart": True, "start_at_robot": False, "use_pose_topic": pose_topic, **parameters}
        # The domain is exclusive to this process, so discovery of other nodes is not needed.
        parameters = {"discovery_wait": 0.0, **parameters}
        # The files come first: if two rules match a node, the later rule applies.
        file_arguments = [argument for file in files for argument in ("--params-file", str(file))]
        clock = f"use_sim_time:={str(sim_time).lower()}"
        arguments = ["--ros-args", *file_arguments, "-p", clock, "--log-level", "warn"]
        for name, value in parameters.items():
            arguments += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        self.context = Context()
        rclpy.init(context=self.context, args=arguments + in_name_space(name_space)[1:])
        self.name_space = f"/{name_space}".rstrip("/")
        self.node = TrackingNode(overrides=overrides, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        kind = FakeBase if sim_time else WallClockBase
        self.base = kind(
            self.spin, plant, stamped=parameters.get("stamped", True), pose_topic=pose_topic, name_space=name_space
        )
        try:
            if sim_time:
                self.base.until(self.has_clock, "the first clock")
            self.node.bring_up()
            if parameters["autostart"]:
                self.await_inputs()
            if drive:
                response = self.trigger("start")
                assert response.success, response.message
        except BaseException:
            self.close()
            raise

    def has_clock(self):
        self.base.clock.publish(Clock(clock=time_message(self.base.now)))
        return self.node.get_clock().now().nanoseconds == START

    def await_inputs(self):
        """Wait until every input has arrived once and no tick is pending: `start` would count it."""
        self.base.until(self.has_received_inputs, "sensors")
        self.base.until(lambda: self.base.now <= self.node.get_clock().now().nanoseconds, "the last clock")
        for _ in range(20):
            self.spin()

    def has_received_inputs(self):
        """Return True if every input has arrived once; discovery may lose earlier messages."""
        self.base.silent(1)
        inbox = self.node._inbox
        topics = [inbox.odometry, inbox.imu, inbox.pose] if self.base.pose_topic else [inbox.odometry, inbox.imu]
        return all(topic.accepted for topic in topics) and bool(self.base.commands)

    def spin(self):
        self.executor.spin_once(timeout_sec=0.0)

    @property
    def loop(self):
        return self.node._loop

    def call(self, kind, name, request):
        """Call a service of the node over DDS.

        Fast DDS may lose a service permanently (ros2/rmw_fastrtps#792), and a response to a client that the node has
        not discovered yet: a new participant discovers both again and repeats the request.
        """
        with ExitStack() as stack:
            node = self.base.node
            for _ in range(2):
                client = node.create_client(kind, name)
                stack.callback(node.destroy_client, client)
                is_ready = self.wait_for(client.service_is_ready, DISCOVERY)
                if is_ready and self.wait_for(lambda: self.node.count_clients(name) > 0, DISCOVERY):
                    future = client.call_async(request)
                    if self.wait_for(future.done, PATIENCE):
                        return future.result()
                node = stack.enter_context(self.new_participant())
        raise AssertionError(f"timed out waiting for {name}")

    def wait_for(self, condition, timeout):
        """Wait for a condition; return False after `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.base.spin()
        return True

    @contextmanager
    def new_participant(self):
        """Yield a node in a new context; the base's loop spins it as well."""
        context = Context()
        rclpy.init(context=context, args=[])
        node = rclpy.create_node("second_caller", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        spin = self.base.spin_node
        self.base.spin_node = lambda: (spin(), executor.spin_once(timeout_sec=0.0))
        try:
            yield node
        finally:
            self.base.spin_node = spin
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)

    def trigger(self, name):
        """Call a service of the node without arguments; return its response."""
        return self.call(Trigger, f"{self.name_space}/diffdrive_mpc/{name}", Trigger.Request())

    def change(self, number):
        """Request a transition of the lifecycle; return True if it succeeded."""
        previous = self.state
        request = ChangeState.Request(transition=Transition(id=number))
        success = self.call(ChangeState, "/diffdrive_mpc/change_state", request).success
        # If the first response was lost, the second request is refused because the transition is done.
        return success or self.state != previous

    @property
    def state(self):
        return self.node._state_machine.current_state

    def listen(self, kind, topic, qos=10):
        """Return a list that collects the messages of a topic from now on."""
        messages = []
        self.base.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def publisher(self, kind, topic, qos=1):
        """Create a publisher of the base and wait until both sides have discovered each other."""
        name = self.base.node.resolve_topic_name(topic)
        (reader,) = [item for item in self.node.subscriptions if item.topic_name == name]
        count = reader.get_publisher_count()
        publisher = self.base.node.create_publisher(kind, topic, qos)
        self.base.until(lambda: publisher.get_subscription_count() > 0, "the node's subscription")
        self.base.until(lambda: reader.get_publisher_count() > count, "the publisher")
        return publisher

    def close(self):
        self.base.close()
        self.executor.shutdown()
        self.node.stop()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@contextmanager
def stack(*arguments, **parameters):
    running_stack = Stack(*arguments, **parameters)
    try:
        yield running_stack
    finally:
        running_stack.close()
