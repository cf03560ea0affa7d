"""Scenarios of the node over DDS in lock step: rows of `ros_scenarios.yaml`.

A row has parameters of the node and steps. A step names methods of `Scenario` with their arguments, called in the order
of the row; `$key` takes its value from each of the `cases`. From tick to tick no command changes by more than `change`:
the limit of slew, of braking (the default) or `any`.
"""

import math
import re
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from ros_parts import CONFIG, DT, stack
from std_msgs.msg import Empty
from std_srvs.srv import SetBool
from test_ros_parameters import set_over_dds

from diffdrive_mpc import Controller

ROWS = yaml.safe_load(Path(__file__).with_name("ros_scenarios.yaml").read_text(encoding="utf-8"))
LIMITS = CONFIG.limits
RATES = {
    "slew": np.array([LIMITS.v_slew, LIMITS.omega_slew]),
    "braking": np.maximum([LIMITS.v_slew, LIMITS.omega_slew], [LIMITS.v_braking, LIMITS.omega_braking]),
    "any": np.full(2, math.inf),
}
SECONDS = {
    "braking": max(LIMITS.v / LIMITS.v_braking, LIMITS.omega / LIMITS.omega_braking) + DT,
    "slowing": max(LIMITS.v / LIMITS.v_slew, LIMITS.omega / LIMITS.omega_slew) + DT,
}
"""Duration from full speed to rest [s]."""
TYPES = {"TwistStamped": TwistStamped, "Empty": Empty, "Odometry": Odometry}


class Scenario:
    """Steps and expectations of a row; `commands` (n, 2) are the commands of the last `ticks`."""

    def __init__(self, s, monkeypatch, capfd):
        self.s, self.base, self.monkeypatch, self.capfd = s, s.base, monkeypatch, capfd
        self.all, self.publishers, self.message = [], {}, ""
        self.diagnosed = s.listen(DiagnosticArray, "/diagnostics")

    # Actions.

    def ticks(self, count):
        self.commands = self.base.run(count)
        self.all.append(self.commands)

    def seconds(self, duration):
        self.ticks(math.ceil(SECONDS.get(duration, duration) / DT))

    def silent(self, duration):
        self.base.silent(math.ceil(SECONDS.get(duration, duration) / DT))

    def inactive(self, ticks):
        assert self.base.silent(ticks) == 0

    def spin(self, count):
        count_before = len(self.base.commands)
        for _ in range(count):
            self.base.spin()
        assert len(self.base.commands) == count_before

    def odometry(self, change):
        """Change entries of odometry, given by dotted names; "lost" drops all messages, "good" changes none."""

        def tamper(message):
            for key, value in change.items():
                *parents, name = key.split(".")
                setattr(reduce(getattr, parents, message), name, value)
            return message

        self.base.tamper = {"lost": lambda _: None, "good": lambda message: message}.get(str(change), tamper)

    def robot(self, values):
        for name, value in values.items():
            setattr(self.base, name, value)
        self.base.plant.reset(self.base.plant.true_pose)

    def fault(self, text):
        def fail(*_, **__):
            raise ZeroDivisionError(text)

        self.monkeypatch.setattr(self.s.node._controller, "step", fail)

    def mend(self, _):
        self.monkeypatch.undo()

    def service(self, name):
        if name not in ("hold", "release"):
            return self.s.trigger(name)
        return self.s.call(SetBool, "/diffdrive_mpc/hold", SetBool.Request(data=name == "hold"))

    def call(self, name):
        response = self.service(name)
        assert response.success, response.message
        self.message = response.message

    def refuse(self, name):
        response = self.service(name)
        assert not response.success
        self.message = response.message

    def transitions(self, names):
        for name in names.split():
            assert self.s.change(getattr(Transition, f"TRANSITION_{name.upper()}"))

    def refuse_transition(self, fields):
        self.capfd.readouterr()
        request = ChangeState.Request(transition=Transition(**fields))
        assert not self.s.call(ChangeState, "/diffdrive_mpc/change_state", request).success
        (self.message,) = [
            line for line in self.capfd.readouterr().err.splitlines() if line[:6] in ("[WARN]", "[ERROR")
        ]

    def sensors(self, _):
        self.s.await_inputs()

    def parameters(self, values):
        self.s.node.set_parameters([Parameter(name, value=value) for name, value in values.items()])

    def set_over_dds(self, values):
        result = set_over_dds(self.s, **values)
        self.message = result.reason
        return result.successful

    def set(self, values):
        assert self.set_over_dds(values), self.message

    def refuse_set(self, values):
        assert not self.set_over_dds(values)

    def limit(self, fields):
        from nav2_msgs.msg import SpeedLimit

        if "limit" not in self.publishers:
            self.publishers["limit"] = self.s.publisher(SpeedLimit, "speed_limit", 10)
        self.publishers["limit"].publish(SpeedLimit(**fields))

    def publisher(self, name):
        """Create a publisher `node kind topic`, of the base or of another node."""
        owner, kind, topic = name.split()
        node = self.base.node if owner == "fake_base" else rclpy.create_node(owner, context=self.base.context)
        qos = qos_profile_sensor_data if kind == "Odometry" else 1
        self.publishers[name] = node, node.create_publisher(TYPES[kind], topic, qos)

    def remove_publisher(self, name):
        node, publisher = self.publishers.pop(name)
        node.destroy_publisher(publisher)
        if node is not self.base.node:
            node.destroy_node()

    # Expectations.

    def reply(self, text):
        assert self.message == text

    def reply_ends(self, text):
        assert self.message.endswith(text)

    def reply_has(self, text):
        assert text in self.message

    def rests(self, when):
        """Check that the last ticks are at rest: `throughout`, or at the `end`."""
        assert not (self.commands if when == "throughout" else self.commands[-1]).any()

    def brakes_hard(self, _):
        """Check that the last ticks brake to rest at the braking limit."""
        ticks = math.ceil(self.all[-2][-1, 0] / (LIMITS.v_braking * DT) - 1e-9)
        assert not self.commands[ticks:].any()

    def last_sent(self, command):
        assert self.base.commands[-1] == tuple(command)

    def faster_than(self, v):
        assert self.commands[-1, 0] > v

    def slower_than(self, v):
        assert np.abs(self.commands[-20:, 0]).max() <= v + 1e-9

    def mode(self, mode):
        assert self.s.loop.last.mode == mode, self.s.loop.last

    def state(self, name):
        assert self.s.loop.state.name == name

    def says(self, text):
        assert text in self.s.loop.last.message

    def lifecycle(self, name):
        state = self.s.call(GetState, "/diffdrive_mpc/get_state", GetState.Request()).current_state
        assert (state.id, state.label) == (getattr(State, f"PRIMARY_STATE_{name.upper()}"), name)

    def failure(self, text):
        assert text in self.s.node.failure

    def logs(self, text):
        self.base.until(lambda: text in self.capfd.readouterr().err, text)

    def limited_to(self, v):
        expected = v if v is None else pytest.approx(v)
        self.base.until(lambda: self.s.node._controller.speed_limit == expected, "the limit")

    def limit_fault(self, text):
        fault = self.s.node.parts["speed_limit"].fault
        assert text in fault if text else not fault

    def objection(self, text):
        self.base.until(lambda: text in self.s.loop.stop_reason if text else not self.s.loop.stop_reason, "objection")

    def warning(self, text):
        self.base.until(lambda: text in self.s.loop.warning if text else not self.s.loop.warning, "warning")

    def diagnoses(self, row):
        """Wait for diagnostics with a level, a pattern, and values."""
        level, pattern, *values = row
        self.diagnosed.clear()

        def is_reported():
            statuses = [message.status[0] for message in self.diagnosed]
            return any(
                status.level == getattr(DiagnosticStatus, level)
                and re.search(pattern, status.message)
                and {(item.key, item.value) for item in status.values} >= {tuple(value) for value in values}
                for status in statuses
            )

        self.base.until(is_reported, f"diagnostics: {row}")

    def warned_once(self, pattern):
        assert len(re.findall(pattern, self.capfd.readouterr().err)) == 1

    def configured(self, values):
        """Check values of the active configuration; `default` is all of it."""
        config = self.s.node._controller.config
        if values == "default":
            assert config == Controller(CONFIG).config
        else:
            assert {name: reduce(getattr, name.split("."), config) for name in values} == values

    def structure(self, name):
        assert self.s.node._controller.model.structure == name

    def sides(self, values):
        limits = self.s.node._controller.config.limits
        assert {name: list(getattr(limits, name).sides) for name in values} == values

    def within(self, distance):
        assert np.abs(self.base.plant.true_pose[:2]).max() < distance

    def off_circle(self, distance):
        x, y, _ = self.base.plant.true_pose
        assert abs(math.hypot(x, y - 1.0) - 1.0) < distance

    def delay_exceeds(self, seconds):
        assert self.s.loop.last.result.reference_delay > seconds

    def remember(self, _):
        self.first_drive = self.s.loop.drive

    def same_reference(self, _):
        assert self.s.loop.drive is self.first_drive


def rows():
    """Return the parameters of each row and of each of its cases."""
    parameters = []
    for name, row in ROWS.items():
        marks = [pytest.mark.system(*row["system"])] if "system" in row else []
        for case in row.get("cases", [{}]):
            label = " ".join([name, *map(str, [*case.values()][-1:])])
            parameters.append(pytest.param(row, case, id=label, marks=marks))
    return parameters


@pytest.mark.parametrize(("row", "case"), rows())
def test_scenario(row, case, monkeypatch, capfd, request):
    def fill(value):
        return case[value[1:]] if isinstance(value, str) and value.startswith("$") else value

    if "compiler" in row.get("system", ()):
        request.getfixturevalue("ros_types")
    parameters = {"drive": True, "diagnostics_rate": 20.0} | {key: fill(v) for key, v in row.get("node", {}).items()}
    with stack(row.get("config"), **parameters) as s:
        scenario = Scenario(s, monkeypatch, capfd)
        for step in row["steps"]:
            for name, value in step.items():
                getattr(scenario, name)(fill(value))
    commands = np.vstack([np.empty((0, 2)), *scenario.all])
    assert np.isfinite(commands).all()
    assert (np.abs(commands) <= [LIMITS.v + 1e-9, LIMITS.omega + 1e-9]).all()
    steps, increases = np.abs(np.diff(commands, axis=0)), np.diff(np.abs(commands), axis=0)
    change = row.get("change", "braking")
    assert (steps <= RATES[change] * DT + 1e-9).all()
    assert (increases <= RATES["any" if change == "any" else "slew"] * DT + 1e-9).all()
