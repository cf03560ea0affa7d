"""`make fuzz FUZZ=live`: attack a node over DDS and judge its commands."""

from __future__ import annotations

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

# Before rclpy is imported, so that no other robot is reached.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_LOG_DIR", tempfile.mkdtemp(prefix="ros-log-"))

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from diffdrive_mpc.mpc.ros.conversions import stamped_pose_message
from fuzz import odd
from fuzz.live.base import BLINDING, CHANGES, PERIOD, Base, damaged, make_change
from fuzz.live.judge import SLACK, Account, Allowed, faults
from fuzz.live.node_process import NodeProcess

NODE = "/diffdrive_mpc"
_PATIENCE = 30.0
_START_PATIENCE = 180.0
"""Time for a node that first compiles, on a busy machine [s]."""
_TICKS = 0.1
"""Time of ticks and messages in addition to the stated times [s]."""
_MAX_GROWTH = 60.0
"""Memory growth of a node after its first campaigns [MB]."""
_CAMPAIGNS = 10
"""Campaigns of one node."""
LIVES: tuple[dict[str, object], ...] = (
    {"start_at_robot": True},
    {"start_at_robot": True, "use_pose_topic": True, "drive_on_reference": True, "record": True},
    {"start_at_robot": False, "use_sim_time": True, "use_imu": False, "trajectory": "s"},
    {"start_at_robot": True, "use_pose_topic": True, "use_sim_time": True},
)
"""Parameters of the attacked nodes, in turns."""
_LIMITS = ("limits.v", "limits.omega", "limits.v_slew", "limits.omega_slew", "sample_time")
_LIMITS += ("expert.limits.v_braking", "expert.limits.omega_braking", "odom_timeout", "failure.max_pose_age")


class LostError(Exception):
    """The node does not answer, or its process ended."""


class Attacker:
    """A node, a base in front of it, and the account of what happens."""

    def __init__(self, folder: Path, settings: dict[str, object]) -> None:
        self.settings, self.account, self.mode = settings, Account(), ""
        self.node = rclpy.create_node("attacker")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.base = Base(self.node, sim_time=bool(settings.get("use_sim_time")))
        self.frame = "map" if settings.get("use_pose_topic") else "odom"
        self.paths = self.node.create_publisher(PathMessage, "set_path", 10)
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, f"{NODE}/mode", self._take_mode, latched)
        log = folder / f"node-{time.monotonic_ns()}.log"
        self.process = NodeProcess(log, {**settings, "record_folder": folder / "records"})
        self._active_since: float | None = None
        self.clients: dict[str, Any] = {}
        try:
            self.call(GetState, "get_state", patience=_START_PATIENCE)
            names = sorted(self.call(ListParameters, "list_parameters").result.names)
            values = self.call(GetParameters, "get_parameters", names=names).values
        except BaseException:
            self.close()
            raise
        self.defaults = dict(zip(names, values, strict=True))
        self.limits = {name: self.defaults[name].double_value for name in _LIMITS}
        self.note_limits(self.limits)

    def _take_mode(self, message: String) -> None:
        self.mode = message.data
        self.account.modes.append((time.monotonic(), message.data))

    def spin(self, seconds: float) -> None:
        """Let `seconds` pass."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0.0:
            self.base.tick_if_due()
            self.executor.spin_once(timeout_sec=min(rest, 0.5 * PERIOD))

    def wait(self, condition: Callable[[], bool], subject: str, patience: float = _PATIENCE) -> None:
        """Let time pass until the condition holds; raises LostError."""
        end = time.monotonic() + patience
        while not condition():
            if not self.process.alive:
                raise LostError(f"the node ended with {self.process.process.returncode} (waiting for {subject})")
            if time.monotonic() > end:
                raise LostError(f"no {subject} within {patience:.0f} s; mode {self.mode!r}")
            self.spin(0.01)

    def call(self, kind: Any, name: str, *, patience: float = _PATIENCE, **fields: object) -> Any:
        """Call a service of the node and return its response."""
        if name not in self.clients:
            self.clients[name] = self.node.create_client(kind, f"{NODE}/{name}")
        client = self.clients[name]
        self.wait(client.service_is_ready, name, patience)
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done, name)
        return future.result()

    def trigger(self, name: str) -> bool:
        """Call `start`, `pause` or `reset`; return True if it is accepted."""
        if name != "pause":
            self.account.requested.append(time.monotonic())
        return bool(self.call(Trigger, name).success)

    def transition(self, number: int) -> None:
        """Request a transition; the command may fall to zero until its response."""
        self.end_activity()
        start = time.monotonic()
        self.call(ChangeState, "change_state", transition=Transition(id=number))
        self.account.requested += [start + 0.1 * i for i in range(int(10 * (time.monotonic() - start)) + 2)]

    def end_activity(self) -> None:
        """Record that no more commands are due."""
        if self._active_since is not None:
            self.account.active.append((self._active_since, time.monotonic()))
            self._active_since = None

    def set(self, values: dict[str, ParameterValue]) -> None:
        """Set parameters and note limits: requested ones may hold from now on, accepted ones hold afterwards."""
        finite = {k: v.double_value for k, v in values.items() if k in _LIMITS and math.isfinite(v.double_value)}
        self.note_limits(self.limits | {name: max(value, self.limits[name]) for name, value in finite.items()})
        self.call(SetParameters, "set_parameters", parameters=[Parameter(name=k, value=v) for k, v in values.items()])
        present = self.call(GetParameters, "get_parameters", names=list(_LIMITS)).values
        self.limits = {name: value.double_value for name, value in zip(_LIMITS, present, strict=True)}
        self.note_limits(self.limits)

    def note_limits(self, values: dict[str, float]) -> None:
        """Record limits that hold from now on."""
        rates = [max(values[f"limits.{name}_slew"], values[f"expert.limits.{name}_braking"]) for name in ("v", "omega")]
        step = (values["sample_time"] * rates[0], values["sample_time"] * rates[1])
        self.account.allowed.append(Allowed(time.monotonic(), (values["limits.v"], values["limits.omega"]), step))

    @property
    def braking(self) -> float:
        """Time of the braking ramp from the limits [s]."""
        ramps = (self.limits[f"limits.{n}"] / self.limits[f"expert.limits.{n}_braking"] for n in ("v", "omega"))
        return _TICKS + max(ramps)

    def recover(self) -> None:
        """End all attacks, restore parameters and activate the node."""
        self.base.changes.clear()
        self.base.blocked = self.base.clock_stands = False
        self.spin(0.1)
        steps = {
            State.PRIMARY_STATE_ACTIVE: Transition.TRANSITION_DEACTIVATE,
            State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
            State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
        }
        if (state := self.state) == State.PRIMARY_STATE_ACTIVE:
            self.transition(steps[state])
        self.set(self.defaults)
        for _ in range(6):
            if (state := self.state) == State.PRIMARY_STATE_ACTIVE:
                self._active_since = time.monotonic()
                return
            self.transition(steps[state])
            self.spin(0.05)
        raise LostError("the node cannot be activated")

    @property
    def state(self) -> int:
        """Lifecycle state of the node."""
        return int(self.call(GetState, "get_state").current_state.id)

    def drive(self, patience: float = 15.0) -> None:
        """Start and wait until the node tracks its reference."""
        self.call(SetBool, "hold", data=False)
        if not self.settings["start_at_robot"]:
            self.base.pose, self.base.twist = [0.0, 0.0, 0.0], [0.0, 0.0]
        self.spin(0.2)
        self.wait(lambda: self.trigger("reset"), "accepted reset", patience)
        self.wait(lambda: self.trigger("start"), "accepted start", patience)
        self.wait(lambda: abs(self.base.twist[0]) > 0.15 and self.mode.startswith("TRACKING"), "tracking", patience)

    def judge(self) -> list[str]:
        """Return promises broken since the last call, and internal errors in the log of the node."""
        self.end_activity()
        self.spin(0.3)
        account = self.account
        account.commands, account.stood = self.base.commands, self.base.standing
        self.base.commands, self.base.standing = account.commands[-1:], []
        self.account = Account(modes=account.modes[-1:], allowed=account.allowed[-1:])
        return [*faults(account), *(f"log: {line}" for line in self.process.alarms())]

    def close(self) -> None:
        """End the node."""
        self.process.end()
        self.executor.shutdown()
        self.node.destroy_node()


def _tamper(attacker: Attacker, random: Random) -> None:
    topic, name = random.choice(("odom", "odom", "imu", "pose")), random.choice((*CHANGES, ""))
    if name:
        attacker.base.changes[topic] = make_change(name, random)
    else:
        attacker.base.changes.pop(topic, None)


def _reference(attacker: Attacker, random: Random) -> None:
    """Publish a path ahead of the robot: good, odd or damaged."""
    x, y, theta = attacker.base.pose
    step = random.choice((0.06, 0.06, 0.06, 0.0, 6.0, -0.06, odd.number(random)))
    points = [[x + step * i * math.cos(theta), y + step * i * math.sin(theta), theta] for i in range(20)]
    if random.random() < 0.3:
        points[random.randrange(20)][random.randrange(3)] = odd.number(random)
    points *= random.choice((1, 1, 1, 0, 2, 1000))
    frame = random.choice((attacker.frame, attacker.frame, attacker.frame, "", "elsewhere"))
    now = max(attacker.base.now, 0)
    message = PathMessage(poses=[stamped_pose_message(point, now, frame) for point in points])
    message.header.frame_id = frame
    attacker.paths.publish(message if random.random() < 0.9 else damaged(message, random))


def _parameters(attacker: Attacker, random: Random) -> None:
    """Set odd values of the types of the parameters, or of other types."""
    excluded = ("config", "record_folder", "use_sim_time", "stamped", "use_pose_topic", "autostart", "qos")
    names = [name for name in attacker.defaults if not name.startswith(excluded)]
    if random.random() < 0.6:
        names = [name for name in names if name.startswith(("weights.", "limits."))]
    values = {}
    for name in random.sample(names, random.choice((1, 2, 5))):
        kind = attacker.defaults[name].type if random.random() < 0.85 else random.randrange(10)
        number = attacker.defaults[name].double_value or 1.0
        values[name] = ParameterValue(
            type=kind,
            bool_value=random.random() < 0.5,
            integer_value=random.choice([value for value in odd.INTEGERS if abs(value) < 2**63]),
            double_value=random.choice((odd.number(random), number * 10 ** random.uniform(-1, 1))),
            string_value=random.choice(("", "nan", "/dev/null", "a" * 5000, "\x1b[31mred\x1b[0m")),
        )
        if kind != ParameterType.PARAMETER_DOUBLE:
            values[name].double_value = 0.0
    attacker.set(values)


def _move(attacker: Attacker, random: Random) -> None:
    """Move, block or release the robot, or shift or stop its clock."""
    attacker.base.pose = [value + random.choice((0.0, 0.05, 0.3, -0.4)) for value in attacker.base.pose]
    attacker.base.blocked = random.random() < 0.3
    attacker.base.clock_offset += random.choice((0.0, 0.0, 0.05, -1.0, 1.0, -30.0, 1000.0))
    attacker.base.clock_stands = random.random() < 0.2


ACTIONS: dict[str, Callable[[Attacker, Random], object]] = {
    "tamper": _tamper,
    "reference": _reference,
    "parameters": _parameters,
    "move": _move,
    "service": lambda attacker, random: attacker.trigger(random.choice(("start", "start", "pause", "resume", "reset"))),
    "hold": lambda attacker, random: attacker.call(SetBool, "hold", data=random.random() < 0.5),
    # Shutdown (5, 6, 7) is final.
    "transition": lambda attacker, random: attacker.transition(random.choice((1, 2, 3, 4, 3, 4, 0, 8, 10, 62, 255))),
}


def _storm(attacker: Attacker, random: Random, actions: list[str]) -> None:
    """Perform many actions in any order."""
    for _ in range(random.choice((5, 10, 20))):
        actions.append(random.choice(("tamper", "tamper", "reference", *ACTIONS)))
        ACTIONS[actions[-1]](attacker, random)
        attacker.spin(random.choice((0.0, 0.0, 0.02, 0.1, 0.4)))


def _named_fault(attacker: Attacker, random: Random, actions: list[str]) -> None:
    """Start a fault in a drive; the command has to be zero within the stated time."""
    limits, braking = attacker.limits, attacker.braking
    faults_of_topics = {"odom": limits["odom_timeout"] + braking}
    if attacker.settings.get("use_pose_topic"):
        faults_of_topics["pose"] = limits["failure.max_pose_age"] + braking
    requests: dict[str, tuple[float, Callable[[], object]]] = {
        "pause": (braking, lambda: attacker.trigger("pause")),
        "hold": (braking, lambda: attacker.call(SetBool, "hold", data=True)),
        "deactivate": (_TICKS, lambda: attacker.transition(Transition.TRANSITION_DEACTIVATE)),
    }
    blinding = [(topic, change) for topic in faults_of_topics for change in BLINDING]
    topic, change = random.choice([*blinding, *((name, "") for name in 3 * [*requests])])
    actions.append(f"{topic} {change}".strip())
    attacker.spin(random.uniform(0.0, 1.0))
    start = time.monotonic()
    if change:
        within = faults_of_topics[topic]
        attacker.base.changes[topic] = make_change(change, random)
    else:
        within, request = requests[topic]
        request()
    # A request counts from its response on.
    deadline = (start if change else time.monotonic()) + within + SLACK
    attacker.spin(deadline + 1.0 - time.monotonic())
    attacker.account.zero.append((deadline, time.monotonic() - 0.05, actions[-1]))


ATTACKS = (_named_fault, _storm)
"""Kinds of campaigns, in turns."""


class Attack:
    """Campaigns from a seed, with findings and counts."""

    def __init__(self, seed: int, folder: Path, end: float) -> None:
        self.seed, self.folder, self.end = seed, folder, end
        self.findings: list[str] = []
        self.counts: Counter[str] = Counter()

    def life(self, numbers: range) -> None:
        """Run campaigns on one node until the first finding."""
        attacker = Attacker(self.folder, LIVES[numbers.start // _CAMPAIGNS % len(LIVES)])
        used: list[tuple[float, int]] = []
        try:
            for number in numbers:
                if self.findings or time.monotonic() > self.end:
                    return
                self._campaign(attacker, number, is_first=number == numbers.start)
                used.append(attacker.process.used())
            if not self.findings and len(numbers) == _CAMPAIGNS:
                self.findings += self._growth(used[2:])
        except LostError as error:
            self.findings.append(f"lost: {error}; see {attacker.process.log}")
        finally:
            attacker.close()

    def _campaign(self, attacker: Attacker, number: int, *, is_first: bool) -> None:
        """Run a campaign on a driving node; afterwards it has to drive again, which starts the next campaign."""
        random, actions = Random(f"live/{self.seed}/{number}"), list[str]()
        findings: list[str] = []
        try:
            if is_first:
                attacker.recover()
                attacker.drive()
            ATTACKS[number % len(ATTACKS)](attacker, random, actions)
            attacker.recover()
            attacker.drive()
        except LostError as error:
            findings.append(f"lost: {error}")
        self.counts.update(actions)
        findings += attacker.judge()
        if not attacker.process.alive:
            findings.append(f"ended: with {attacker.process.process.returncode}")
        if findings:
            path = self.folder / f"campaign-{self.seed}-{number}.json"
            content = {"settings": attacker.settings, "actions": actions, "findings": findings}
            path.write_text(json.dumps(content, indent=1))
            self.findings += [f"campaign {number} of seed {self.seed}: {finding}" for finding in findings[:4]]
            self.findings[-1] += f"\n    {path}, {attacker.process.log}"

    @staticmethod
    def _growth(used: list[tuple[float, int]]) -> list[str]:
        """Return findings about memory and threads after the first campaigns, which load modules."""
        (memory, threads), (last_memory, last_threads) = used[0], used[-1]
        findings = [f"memory: {memory:.0f} to {last_memory:.0f} MB"] if last_memory - memory > _MAX_GROWTH else []
        return findings + ([f"threads: {threads} to {last_threads}"] if last_threads > threads else [])


def main(seconds: float, seed: int, folder: Path | None, number: int | None) -> int:
    """Run campaigns for `seconds`, or campaign `number` alone; return the number of findings."""
    folder = folder or Path(tempfile.mkdtemp(prefix="fuzz-live-"))
    folder.mkdir(parents=True, exist_ok=True)
    attack = Attack(seed, folder, time.monotonic() + seconds)
    rclpy.init(args=["--ros-args", "--log-level", "fatal"])
    try:
        if number is not None:
            attack.life(range(number, number + 1))
        start = 0
        while number is None and not attack.findings and time.monotonic() < attack.end:
            attack.life(range(start, start + _CAMPAIGNS))
            start += _CAMPAIGNS
    finally:
        rclpy.try_shutdown()
    counts = ", ".join(f"{name} {count}" for name, count in sorted(attack.counts.items()))
    print(f"live         seed {seed}: {len(attack.findings)} findings; {counts}")
    for finding in attack.findings:
        print(f"  - {finding}")
    if attack.findings:
        print(f'    make fuzz FUZZ="live --seed {seed} --only NUMBER" repeats a campaign; logs are in {folder}')
    return len(attack.findings)
