"""Whoever stands before the node: a base that drives, and hands on every door of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory

from fuzz import odd
from fuzz.live import references, tampering
from fuzz.live.around import WAYS, around
from fuzz.live.base import PERIOD, Base
from fuzz.live.doors import TAMPERED_TRANSFORMS, Doors, tamper_transforms
from fuzz.live.judge import Account, Allowed
from fuzz.live.node_process import NodeProcess

NODE = "/diffdrive_mpc"
PATIENCE = 30.0
# A node that has to compile first, on a machine that does other things too [s].
_STARTS = 180.0
_LIMITS = (
    "limits.v",
    "limits.omega",
    "limits.v_slew",
    "limits.omega_slew",
    "expert.limits.v_braking",
    "expert.limits.omega_braking",
    "sample_time",
)
# Where it writes to is no door, and a robot that nobody drives is not the matter.
_LEFT_ALONE = {"config", "record_folder", "use_sim_time", "stamped", "use_pose_topic", "autostart"}


class LostError(Exception):
    """The node does not answer, or does not live any more."""


class Attacker:
    """One life of a node.

    Parameters
    ----------
    folder
        For logs and recordings.
    settings
        Parameters that it starts with: `use_sim_time` and `use_pose_topic` among them.
    """

    def __init__(self, folder: Path, settings: dict[str, object]) -> None:
        self.settings, self.account, self.notes = settings, Account(), list[str]()
        self.node = rclpy.create_node("attacker")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.base = Base(self.node, sim_time=bool(settings.get("use_sim_time")))
        self.doors = Doors(self.node)
        if self.doors.tf is not None:
            self.base.transforms = (self.doors.tf, self.doors.transforms)
        self.base.frame = self.frame
        self.paths = self.node.create_publisher(PathMessage, "set_path", 10)
        self.trajectories = self.node.create_publisher(MultiDOFJointTrajectory, "set_trajectory", 10)
        self.node.create_subscription(String, f"{NODE}/mode", self._take_mode, 10)
        self.mode = ""
        self.clients: dict[str, Any] = {}
        self.process = NodeProcess(
            folder / f"node-{time.monotonic_ns()}.log", {**settings, "record_folder": folder / "records"}
        )
        self._active_since: float | None = None
        try:
            self.wait(lambda: self._client(GetState, f"{NODE}/get_state").service_is_ready(), "the node", _STARTS)
            self.defaults = self.parameters()
        except BaseException:
            self.close()
            raise
        self.known = dict(self.defaults)
        self.note_limits()

    # Time and services

    def spin(self, seconds: float) -> None:
        """Live on for so long."""
        end = time.monotonic() + seconds
        while True:
            self.base.tick_if_due()
            left = end - time.monotonic()
            self.executor.spin_once(timeout_sec=max(0.0, min(left, 0.5 * PERIOD)))
            if left <= 0.0:
                return

    def wait(self, condition: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        """Live on until it holds; raises LostError."""
        end = time.monotonic() + patience
        while not condition():
            if not self.process.alive:
                raise LostError(f"the node died with {self.process.process.returncode} (waiting for {what})")
            if time.monotonic() > end:
                raise LostError(f"waited {patience:.0f} s in vain for {what}; mode {self.mode!r}")
            self.spin(0.01)

    def _client(self, kind: Any, name: str) -> Any:
        if name not in self.clients:
            self.clients[name] = self.node.create_client(kind, name)
        return self.clients[name]

    def call(self, kind: Any, name: str, request: Any, *, answer: bool = True) -> Any:
        """Call a service; without `answer` nobody waits for one."""
        client = self._client(kind, name)
        self.wait(client.service_is_ready, name)
        future = client.call_async(request)
        if not answer:
            return None
        self.wait(future.done, name)
        return future.result()

    def trigger(self, name: str, *, answer: bool = True) -> Any:
        """One of the node's own services."""
        if name in ("reset", "start"):
            self.account.told.append(time.monotonic())
        return self.call(Trigger, f"{NODE}/{name}", Trigger.Request(), answer=answer)

    def hold(self, on: bool, *, answer: bool = True) -> Any:
        """The hold from outside."""
        return self.call(SetBool, f"{NODE}/hold", SetBool.Request(data=on), answer=answer)

    @property
    def state(self) -> int:
        """Number of the lifecycle state."""
        return int(self.call(GetState, f"{NODE}/get_state", GetState.Request()).current_state.id)

    def transition(self, number: int, label: str = "", *, answer: bool = True) -> bool:
        """Ask for a transition; whether it was made."""
        self._not_active()
        asked = ChangeState.Request(transition=Transition(id=number, label=label))
        before = time.monotonic()
        found = self.call(ChangeState, f"{NODE}/change_state", asked, answer=answer)
        # From the request to the answer and a little on: somewhere between it falls to zero.
        now = time.monotonic()
        self.account.told += [before + 0.1 * i for i in range(int(10 * (now - before)) + 2)]
        if found is None:
            return False
        return bool(found.success)

    def take_note_of_activity(self) -> None:
        """Commands are due from now on if it is active."""
        if self.state == State.PRIMARY_STATE_ACTIVE:
            if self._active_since is None:
                self._active_since = time.monotonic()
        else:
            self._not_active()

    def _not_active(self) -> None:
        if self._active_since is not None:
            self.account.active.append((self._active_since, time.monotonic()))
            self._active_since = None

    def _take_mode(self, message: String) -> None:
        self.mode = message.data

    # Parameters

    def names(self) -> list[str]:
        """All parameters."""
        return sorted(self.call(ListParameters, f"{NODE}/list_parameters", ListParameters.Request()).result.names)

    def parameters(self) -> dict[str, ParameterValue]:
        """All of them with their values."""
        names = self.names()
        found = self.call(GetParameters, f"{NODE}/get_parameters", GetParameters.Request(names=names))
        return dict(zip(names, found.values, strict=True))

    def set(self, values: dict[str, ParameterValue], *, atomically: bool = False, answer: bool = True) -> None:
        """Set parameters, all of them or each by itself, and keep account of limits."""
        given = [Parameter(name=name, value=value) for name, value in values.items()]
        touched = [name for name in values if name in _LIMITS]
        if touched:
            # What is being asked for may be in force from now on; what was, for a little longer.
            self.note_limits(values)
        if atomically:
            self.call(
                SetParametersAtomically,
                f"{NODE}/set_parameters_atomically",
                SetParametersAtomically.Request(parameters=given),
                answer=answer,
            )
        else:
            self.call(SetParameters, f"{NODE}/set_parameters", SetParameters.Request(parameters=given), answer=answer)
        if touched and answer:
            self.known = self.parameters()
            self.note_limits()

    def note_limits(self, also: dict[str, ParameterValue] | None = None) -> None:
        """Write down the limits that are known now, or the wider of these and those that are asked for."""
        values = {name: self.known[name].double_value for name in _LIMITS}
        for name, value in (also or {}).items():
            if (
                name in _LIMITS
                and value.type == ParameterType.PARAMETER_DOUBLE
                and value.double_value == value.double_value
            ):
                values[name] = max(values[name], value.double_value)
        dt = values["sample_time"]
        rate = tuple(
            max(values[f"limits.{name}_slew"], values[f"expert.limits.{name}_braking"]) for name in ("v", "omega")
        )
        self.account.allowed.append(
            Allowed(time.monotonic(), (values["limits.v"], values["limits.omega"]), (dt * rate[0], dt * rate[1]))
        )

    # Ways back

    def make_active(self) -> None:
        """Bring it to active, whatever state it is in."""
        for _ in range(6):
            state = self.state
            if state == State.PRIMARY_STATE_ACTIVE:
                self.take_note_of_activity()
                return
            if state == State.PRIMARY_STATE_FINALIZED:
                raise LostError("the node is finalized")
            step = {
                State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
                State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
            }.get(state)
            if step is not None:
                self.transition(step)
            self.spin(0.05)
        raise LostError("it cannot be made active")

    def make_honest(self) -> None:
        """No more tampering; parameters as they were; active, and as new."""
        self.base.tamper.clear()
        self.doors.limit_speed(Random(0), 0.0, percentage=False)
        self.base.held, self.base.clock_stands = False, False
        self.spin(0.1)
        if self.state == State.PRIMARY_STATE_ACTIVE:
            self.transition(Transition.TRANSITION_DEACTIVATE)
        self.known = self.parameters()
        changed = {name: value for name, value in self.defaults.items() if self.known[name] != value}
        if changed:
            self.set(changed)
            self.known = self.parameters()
            left = [name for name in changed if self.known[name] != self.defaults[name]]
            if left:
                raise LostError(f"parameters cannot be set back: {left}")
        self.note_limits()
        self.make_active()

    def good_drive(self, patience: float = 15.0) -> None:
        """It starts, gets under way, and tracks."""
        end = time.monotonic() + patience
        self.hold(False)
        # A limit outlasts a cleanup, and a node that is not configured hears of no other.
        self.doors.limit_speed(Random(0), 0.0, percentage=False)
        self.spin(0.2)
        if not self.settings["start_at_robot"]:
            # Its path begins there.
            self.base.pose, self.base.twist = [0.0, 0.0, 0.0], [0.0, 0.0]
            self.spin(0.2)
        while True:
            if self.trigger("reset").success:
                break
            if time.monotonic() > end:
                raise LostError("reset is refused")
            self.spin(0.2)
        self.wait(lambda: bool(self.trigger("start").success), "start to be accepted", patience)
        self.wait(lambda: abs(self.base.twist[0]) > 0.15 and self.mode.startswith("TRACKING"), "a good drive", patience)

    def close(self) -> None:
        """End it."""
        self._not_active()
        self.process.end()
        self.executor.shutdown()
        self.node.destroy_node()

    # Attacks

    def act(self, action: list[Any], random: Random) -> None:
        """Do one thing; what it draws comes from `random`."""
        getattr(self, f"do_{action[0]}")(random, *action[1:])

    def do_tamper(self, random: Random, topic: str, how: str) -> None:
        """From now on messages of a topic are changed."""
        if how:
            self.base.tamper[topic] = tampering.make(how, random)
        else:
            self.base.tamper.pop(topic, None)

    def do_tf(self, random: Random, how: str) -> None:
        """From now on transforms are changed; empty: no more."""
        self.base.tamper["tf"] = lambda message: tamper_transforms(how, random, message)

    def do_around(self, random: Random, topic: str, how: str) -> None:
        """From now on the costmap or the obstacles are others."""
        self.base.tamper[topic] = around(how, random, self.base.pose)

    def do_speed_limit(self, random: Random, value: float, percentage: bool) -> None:
        """A limit from outside."""
        self.doors.limit_speed(random, value, percentage)

    def do_goal(self, random: Random, name: str, words: str, count: int) -> None:
        """Goals for follow_path, one upon the other."""
        table = references.rows(name, random, self.base.pose)
        frame = random.choice(("odom", "map", "base_link", "", "elsewhere")) if random.random() < 0.2 else self.frame
        for _ in range(count):
            self.doors.send_goal(table, frame, self.base.now, words)

    def do_cancel(self, random: Random) -> None:
        """What was sent is taken back."""
        self.doors.cancel()

    def do_spin(self, random: Random, seconds: float) -> None:
        """Nothing but time."""
        self.spin(seconds)

    def do_reference(self, random: Random, name: str, kind: str, count: int) -> None:
        """A reference, some times at once."""
        table = references.rows(name, random, self.base.pose)
        frame = random.choice(("odom", "odom", "map", "", "elsewhere")) if random.random() < 0.2 else self.frame
        for _ in range(count):
            if kind == "path":
                message = references.path_message(table, frame, self.base.now)
                self.paths.publish(message if random.random() < 0.9 else references.spoilt(message, random))
            else:
                message = references.trajectory_message(table, frame, random.choice((1, 1, 1, 1, 0, 2)))
                self.trajectories.publish(message if random.random() < 0.9 else references.spoilt(message, random))

    @property
    def frame(self) -> str:
        """Frame that the node controls in."""
        elsewhere = self.settings.get("use_pose_topic") or self.settings.get("pose_source") in ("topic", "tf")
        return "map" if elsewhere else "odom"

    def do_service(self, random: Random, name: str, answer: bool) -> None:
        """Start, pause or reset."""
        self.trigger(name, answer=answer)

    def do_hold(self, random: Random, on: bool) -> None:
        """The hold from outside."""
        self.hold(on, answer=random.random() < 0.5)

    def do_transition(self, random: Random, number: int, label: str, answer: bool) -> None:
        """A transition, possible or not."""
        self.transition(number, label, answer=answer)
        self.take_note_of_activity()

    def do_parameters(self, random: Random, count: int, atomically: bool) -> None:
        """Odd values for some parameters."""
        names = [name for name in self.defaults if name not in _LEFT_ALONE and not name.startswith("qos")]
        if random.random() < 0.6:
            names = [name for name in names if name.startswith(("weights.", "limits."))]
        values = {name: odd_value(self.defaults[name], random) for name in random.sample(names, min(count, len(names)))}
        if random.random() < 0.05:
            values["nobody.knows"] = odd_value(ParameterValue(type=3), random)
        self.set(values, atomically=atomically)

    def do_carry(self, random: Random, x: float, y: float, theta: float) -> None:
        """The robot is somewhere else."""
        self.base.pose = [a + b for a, b in zip(self.base.pose, (x, y, theta), strict=True)]

    def do_block(self, random: Random, held: bool) -> None:
        """It cannot move."""
        self.base.held = held

    def do_clock(self, random: Random, shift: float, stands: bool) -> None:
        """The robot's clock leaps or stands, where it has one of its own."""
        self.base.clock_offset += shift
        self.base.clock_stands = stands

    def do_wall_clock(self, random: Random) -> None:
        """To a clock that nobody publishes, and back."""
        if not self.settings.get("use_sim_time"):
            for on in (True, False):
                self.set({"use_sim_time": ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=on)})
                self.spin(0.3)


def odd_value(now: ParameterValue, random: Random) -> ParameterValue:
    """A value in place of `now`: of its type mostly, legal or not."""
    kind = now.type if random.random() < 0.85 else random.randrange(10)
    if kind == ParameterType.PARAMETER_BOOL:
        return ParameterValue(type=kind, bool_value=random.random() < 0.5)
    if kind == ParameterType.PARAMETER_INTEGER:
        value = random.choice(
            (*[one for one in odd.INTEGERS if abs(one) < 2**63], now.integer_value + 1, now.integer_value * 2)
        )
        return ParameterValue(type=kind, integer_value=max(-(2**63), min(2**63 - 1, value)))
    if kind == ParameterType.PARAMETER_DOUBLE:
        at = now.double_value or 1.0
        value = random.choice(
            (odd.number(random), odd.near(at, random), at * 10 ** random.uniform(-1, 1), at * random.uniform(0.5, 2))
        )
        return ParameterValue(type=kind, double_value=value)
    if kind == ParameterType.PARAMETER_STRING:
        text = random.choice(odd.WORDS).replace("\x00", "").encode("utf-8", "replace").decode()
        return ParameterValue(type=kind, string_value=text)
    if kind == ParameterType.PARAMETER_DOUBLE_ARRAY:
        return ParameterValue(type=kind, double_array_value=[odd.number(random)] * 3)
    return ParameterValue(type=kind)


def draw_action(random: Random) -> list[Any]:
    """Something to do to the node."""
    kind = random.choice(
        (
            "tamper",
            "tamper",
            "tamper",
            "reference",
            "reference",
            "service",
            "service",
            "transition",
            "parameters",
            "parameters",
            "carry",
            "block",
            "clock",
            "hold",
            "wall_clock",
            "spin",
            "tf",
            "speed_limit",
            "around",
            "goal",
            "goal",
            "cancel",
        )
    )
    if kind == "tamper":
        return [kind, random.choice(("odom", "odom", "imu", "pose")), random.choice((*tampering.CHANGES, ""))]
    if kind == "reference":
        return [
            kind,
            random.choice(references.NAMES),
            random.choice(("path", "trajectory")),
            random.choice((1, 1, 2, 5)),
        ]
    if kind == "service":
        return [kind, random.choice(("start", "start", "start", "pause", "reset")), random.random() < 0.5]
    if kind == "transition":
        # Not shutdown (5, 6, 7) here: there is no way back from it.
        number = random.choice((1, 2, 3, 3, 4, 4, 3, 4, 0, 8, 10, 11, 30, 50, 62, 99, 200, 255))
        label = random.choice(
            ("", "", "", "", "activate", "deactivate", "configure", "cleanup", "nonsense", "a" * 5000)
        )
        return [kind, number, label, random.random() < 0.7]
    if kind == "parameters":
        return [kind, random.choice((1, 1, 2, 5, 40)), random.random() < 0.3]
    if kind == "tf":
        return [kind, random.choice(TAMPERED_TRANSFORMS)]
    if kind == "around":
        return [kind, random.choice(("costmap", "obstacles")), random.choice(WAYS)]
    if kind == "speed_limit":
        value = random.choice((0.0, 0.2, 0.4, 50.0, 100.0, 1e-9, -1.0, odd.number(random)))
        return [kind, value, random.random() < 0.5]
    if kind == "goal":
        words = random.choice(("", "", "", "FollowPath", "nobody"))
        return [kind, random.choice(references.NAMES), words, random.choice((1, 1, 2, 5))]
    if kind == "carry":
        return [kind, *[random.choice((0.0, 0.05, 0.3, 1.5, -0.4)) for _ in range(3)]]
    if kind == "block":
        return [kind, random.random() < 0.5]
    if kind == "clock":
        return [kind, random.choice((0.0, 0.0, 0.05, -0.05, -1.0, 1.0, -30.0, 1000.0)), random.random() < 0.2]
    if kind == "hold":
        return [kind, random.random() < 0.5]
    return ["spin", 0.5] if kind == "spin" else [kind]
