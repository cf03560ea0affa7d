"""`make fuzz FUZZ=live`: attacks on a node over DDS, and checks of its commands.

The actions of the attacker follow from its seed; their timing depends on DDS and the machine.
"""

from __future__ import annotations

import copy
import json
import math
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

# Set before the import of rclpy, so that no other robot is reached.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="ros-log-"))

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from diffdrive_mpc.mpc.ros.conversions import nanoseconds, pose_message, stamped_pose_message, time_message
from diffdrive_mpc.mpc.ros.settings import NodeSettings
from fuzz import odd
from fuzz.judge import CONFIG, SLACK, EventLog, ReceivedCommand, faults
from fuzz.node_process import NodeProcess

NODE = "/diffdrive_mpc"
PERIOD, LAG, COMMAND_TIMEOUT = 0.02, 0.1, 0.5
_TIMEOUT, _START_TIMEOUT = 30.0, 180.0
"""Timeout of a response, and of the first response of a node, which may compile first [s]."""
_CAMPAIGNS = 10
"""Number of campaigns of a node."""
NODE_PARAMETERS: tuple[dict[str, object], ...] = (
    {"record": True},
    {"use_pose_topic": True, "drive_on_reference": True},
)
"""Parameters of the attacked nodes, which alternate."""
VALUES = {"not a number": math.nan, "infinite": math.inf, "huge": 1e300}
SHIFTS = {"an hour ago": -3600.0, "far ahead": 1000.0, "a little ahead": 0.15, "no stamp": -1e18, "latest stamp": 1e10}
DISABLING = ("lost", "not a number", "infinite", "other frame", "an hour ago", "far ahead", "no stamp")
"""Changes after which no message is usable."""
CHANGES = (*DISABLING, "huge", "noisy", "a little ahead", "latest stamp", "no orientation", "flood", "garbage")


def change_message(name: str, message: Any, random: Random) -> list[Any]:
    """Return the messages that replace a correct message."""
    if name in VALUES or name == "noisy":
        new_value = VALUES.get(name, odd.near(0.1, random))
        if hasattr(message, "pose"):
            message.pose.pose.position.x = new_value
        if hasattr(message, "twist"):
            message.twist.twist.linear.x = new_value
        if hasattr(message, "angular_velocity"):
            message.angular_velocity.z = new_value
    elif name in SHIFTS:
        stamp = nanoseconds(message.header.stamp) + int(1e9 * SHIFTS[name])
        message.header.stamp = time_message(min(max(stamp, 0), (2**31 - 1) * 10**9))
    elif name == "other frame":
        message.header.frame_id = "elsewhere"
    elif name == "no orientation" and hasattr(message, "pose"):
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
    elif name == "flood":
        return [copy.deepcopy(message) for _ in range(100)]
    elif name == "garbage":
        return [corrupt_message(message, random)]
    return [] if name == "lost" else [message]


def corrupt_message(message: Any, random: Random) -> bytes:
    """Return the serialised message, truncated, with wrong bytes, or with a wrong sequence length."""
    content = bytearray(serialize_message(message))
    kind, index = random.randrange(3), random.randrange(len(content))
    if kind == 0:
        return bytes(content[:index])
    size, replacement = random.choice(((1, random.randbytes(1)), (4, b"\xff\xff\xff\x7f"), (4, b"\x00\x00\x00\x10")))
    content[index // size * size : index // size * size + size] = replacement
    return bytes(content)


class LostError(Exception):
    """Error for a node that does not respond or whose process ended."""


class Attacker:
    """Node, simulated base whose messages can be changed, and log of the events."""

    def __init__(self, folder: Path, settings: dict[str, object]) -> None:
        self.settings, self.events, self.mode = settings, EventLog(), ""
        self.frame = "map" if settings.get("use_pose_topic") else "odom"
        self.pose, self.twist, self.command = [0.0, 0.0, 0.0], [0.0, 0.0], [0.0, 0.0]
        self.changes: dict[str, str] = {}
        self.random, self.clients = Random(0), dict[str, Any]()
        self.is_blocked, self._last_command_time, self._next = False, -math.inf, time.monotonic()
        self.node, self.executor = rclpy.create_node("attacker"), SingleThreadedExecutor()
        self.executor.add_node(self.node)
        kinds = {"odom": Odometry, "imu": Imu, "pose": PoseWithCovarianceStamped}
        self._publishers = {
            name: self.node.create_publisher(kind, name, qos_profile_sensor_data) for name, kind in kinds.items()
        }
        self.paths = self.node.create_publisher(PathMessage, "set_path", 10)
        self.node.create_subscription(TwistStamped, "cmd_vel", self._take_command, QoSProfile(depth=1000))
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, f"{NODE}/mode", self._take_mode, latched)
        parameters = {"start_at_robot": True, "record_folder": folder / "records", **settings}
        self.process = NodeProcess(folder / f"node-{time.monotonic_ns()}.log", parameters)

    def _take_mode(self, message: String) -> None:
        self.mode = message.data
        self.events.modes.append((time.monotonic(), message.data))

    def _take_command(self, message: TwistStamped, info: dict[str, Any]) -> None:
        self._last_command_time, self.command = time.monotonic(), [message.twist.linear.x, message.twist.angular.z]
        self.events.commands.append(
            ReceivedCommand(self._last_command_time, *self.command, info.get("publication_sequence_number"))
        )

    def _tick_if_due(self) -> None:
        """Move the base and publish its sensors; skip missed ticks."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = max(self._next + PERIOD, now)
        target = self.command if now - self._last_command_time < COMMAND_TIMEOUT and not self.is_blocked else [0.0, 0.0]
        self.twist = [value + PERIOD / LAG * (goal - value) for value, goal in zip(self.twist, target, strict=True)]
        heading = self.pose[2] + 0.5 * PERIOD * self.twist[1]
        displacement = PERIOD * self.twist[0] * math.cos(heading), PERIOD * self.twist[0] * math.sin(heading)
        self.pose = [value + d for value, d in zip(self.pose, (*displacement, PERIOD * self.twist[1]), strict=True)]
        messages = {"odom": Odometry(child_frame_id="base_link"), "imu": Imu(), "pose": PoseWithCovarianceStamped()}
        for (name, message), frame in zip(messages.items(), ("odom", "base_link", "map"), strict=True):
            message.header.stamp, message.header.frame_id = time_message(time.time_ns()), frame
            if name != "imu":
                message.pose.pose = pose_message(self.pose)
        messages["odom"].twist.twist.linear.x, messages["odom"].twist.twist.angular.z = self.twist
        messages["imu"].angular_velocity.z = self.twist[1]
        for name, message in messages.items():
            for changed in change_message(self.changes.get(name, ""), message, self.random):
                self._publishers[name].publish(changed)

    def spin(self, seconds: float) -> None:
        """Run the executor and the base for `seconds`."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            self._tick_if_due()
            self.executor.spin_once(timeout_sec=min(remaining, 0.5 * PERIOD))

    def wait(self, condition: Callable[[], bool], subject: str, timeout: float = _TIMEOUT) -> None:
        """Run until the condition is true; raise LostError after a timeout."""
        end = time.monotonic() + timeout
        while not condition():
            if not self.process.alive:
                raise LostError(f"the node ended with {self.process.process.returncode} (waiting for {subject})")
            if time.monotonic() > end:
                raise LostError(f"no {subject} within {timeout:.0f} s; mode {self.mode!r}")
            self.spin(0.01)

    def call(self, kind: Any, name: str, *, timeout: float = _TIMEOUT, **fields: object) -> Any:
        """Call a service of the node and return its response; meanwhile, immediate zero commands are permitted."""
        start = time.monotonic()
        client = self.clients.setdefault(name, None) or self.node.create_client(kind, f"{NODE}/{name}")
        self.clients[name] = client
        self.wait(client.service_is_ready, name, timeout)
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done, name)
        if name in ("change_state", "start", "reset"):
            self.events.requested += [start + 0.1 * i for i in range(int(10 * (time.monotonic() - start)) + 2)]
        return future.result()

    @property
    def state(self) -> int:
        """Lifecycle state of the node."""
        return int(self.call(GetState, "get_state", timeout=_START_TIMEOUT).current_state.id)

    def transition(self, number: int) -> None:
        """Request a transition of the lifecycle."""
        self.call(ChangeState, "change_state", transition=Transition(id=number))

    def drive(self) -> None:
        """End all attacks, activate and start the node, and wait until it tracks; raise LostError after a timeout."""
        self.changes.clear()
        self.is_blocked = False
        if self.state == State.PRIMARY_STATE_ACTIVE:
            self.transition(Transition.TRANSITION_DEACTIVATE)
        if self.state == State.PRIMARY_STATE_UNCONFIGURED:
            self.transition(Transition.TRANSITION_CONFIGURE)
        self.transition(Transition.TRANSITION_ACTIVATE)
        self.call(SetBool, "hold", data=False)
        self.spin(0.2)
        for name in ("reset", "start"):
            self.wait(lambda name=name: self.call(Trigger, name).success, f"accepted {name}")
        self.wait(lambda: abs(self.twist[0]) > 0.15 and self.mode.startswith("TRACKING"), "tracking")

    def judge(self) -> list[str]:
        """Return violations since the last call, and internal errors in the log of the node."""
        self.spin(0.3)
        events, self.events = self.events, EventLog(self.events.commands[-1:], self.events.modes[-1:])
        return [*faults(events), *(f"log: {line}" for line in self.process.alarms())]

    def close(self) -> None:
        """End the node."""
        self.process.end()
        self.executor.shutdown()
        self.node.destroy_node()


def _tamper(attacker: Attacker, random: Random) -> None:
    attacker.changes[random.choice(("odom", "odom", "imu", "pose"))] = random.choice((*CHANGES, ""))


def _reference(attacker: Attacker, random: Random) -> None:
    """Publish a valid, invalid or corrupted path ahead of the robot."""
    x, y, theta = attacker.pose
    step = random.choice((0.06, 0.06, 0.0, 6.0, -0.06, odd.number(random)))
    points = [[x + step * i * math.cos(theta), y + step * i * math.sin(theta), theta] for i in range(20)]
    if random.random() < 0.3:
        points[random.randrange(20)][random.randrange(3)] = odd.number(random)
    points *= random.choice((1, 1, 0, 2, 1000))
    frame = random.choice((attacker.frame, attacker.frame, "", "elsewhere"))
    message = PathMessage(poses=[stamped_pose_message(point, time.time_ns(), frame) for point in points])
    message.header.frame_id = frame
    attacker.paths.publish(message if random.random() < 0.9 else corrupt_message(message, random))


def _move(attacker: Attacker, random: Random) -> None:
    """Move, block or release the robot."""
    attacker.pose = [value + random.choice((0.0, 0.05, 0.3, -0.4)) for value in attacker.pose]
    attacker.is_blocked = random.random() < 0.3


ACTIONS: dict[str, Callable[[Attacker, Random], object]] = {
    "tamper": _tamper,
    "reference": _reference,
    "move": _move,
    "service": lambda attacker, random: attacker.call(Trigger, random.choice(("start", "pause", "resume", "reset"))),
    "hold": lambda attacker, random: attacker.call(SetBool, "hold", data=random.random() < 0.5),
    # Shutdown (5, 6, 7) is final.
    "transition": lambda attacker, random: attacker.transition(random.choice((1, 2, 3, 4, 3, 4, 0, 8, 10, 62, 255))),
}


def _perform_random_actions(attacker: Attacker, random: Random) -> list[str]:
    """Perform many actions in any order."""
    names = random.choices(("tamper", "tamper", "reference", *ACTIONS), k=random.choice((5, 10, 20)))
    for name in names:
        ACTIONS[name](attacker, random)
        attacker.spin(random.choice((0.0, 0.0, 0.02, 0.1, 0.4)))
    return names


def _inject_fault(attacker: Attacker, random: Random) -> list[str]:
    """Start a fault during a drive; the command must become zero within the documented time."""
    limits = CONFIG.limits
    braking = 0.1 + max(limits.v / limits.v_braking, limits.omega / limits.omega_braking)
    timeouts = {"odom": NodeSettings().odom_timeout}
    if attacker.settings.get("use_pose_topic"):
        timeouts["pose"] = CONFIG.failure.max_pose_age
    requests: dict[str, Callable[[], object]] = {
        "pause": lambda: attacker.call(Trigger, "pause"),
        "hold": lambda: attacker.call(SetBool, "hold", data=True),
        "deactivate": lambda: attacker.transition(Transition.TRANSITION_DEACTIVATE),
    }
    disabling = [(topic, change) for topic in timeouts for change in DISABLING]
    name, change = random.choice([*disabling, *((request, "") for request in 3 * [*requests])])
    attacker.spin(random.uniform(0.0, 1.0))
    if change:
        attacker.changes[name] = change
    else:
        requests[name]()
    deadline = time.monotonic() + timeouts.get(name, 0.0) + braking + SLACK
    attacker.spin(deadline + 1.0 - time.monotonic())
    attacker.events.zero.append((deadline, time.monotonic() - 0.05, f"{name} {change}"))
    return [f"{name} {change}".strip()]


def _run_node(numbers: range, seed: int, folder: Path, end: float, counts: Counter[str]) -> list[str]:
    """Run campaigns on one node until the first finding; the node must drive again after each campaign."""
    attacker, findings = (
        Attacker(folder, NODE_PARAMETERS[numbers.start // _CAMPAIGNS % len(NODE_PARAMETERS)]),
        list[str](),
    )
    try:
        attacker.drive()
        for number in numbers:
            if findings or time.monotonic() > end:
                break
            random = attacker.random = Random(f"live/{seed}/{number}")
            actions = (_inject_fault, _perform_random_actions)[number % 2](attacker, random)
            counts.update(actions)
            attacker.drive()
            findings += [f"campaign {number} of seed {seed}, {actions}: {line}" for line in attacker.judge()]
    except LostError as error:
        findings.append(f"lost: {error}; see {attacker.process.log}")
    finally:
        attacker.close()
    return findings


def main(seconds: float, seed: int, number: int | None) -> int:
    """Run campaigns for `seconds`, or campaign `number` alone; return the number of findings."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-live-"))
    end, start, findings, counts = time.monotonic() + seconds, number or 0, list[str](), Counter[str]()
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    try:
        while not findings and time.monotonic() < end:
            findings = _run_node(range(start, start + (_CAMPAIGNS if number is None else 1)), seed, folder, end, counts)
            start += _CAMPAIGNS
            if number is not None:
                break
    finally:
        rclpy.try_shutdown()
    print(f"live         seed {seed}: {len(findings)} findings; {json.dumps(counts, sort_keys=True)}; logs in {folder}")
    print(*(f"  - {finding}" for finding in findings), sep="\n")
    return len(findings)
