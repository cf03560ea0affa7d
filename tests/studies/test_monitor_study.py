"""The monitor behind real controllers on the simulated robot: some faults, some sound drives, and the report."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from studies.monitor import trial
from studies.monitor.faults import FAULTS, Fault, Sent
from studies.monitor.study import MonitorStudyResult, complaint
from studies.monitor.trial import HARM, MonitoredController, faulty_trial, nominal_case, nominal_trial
from typer.testing import CliRunner

from diffdrive_mpc.mpc import Controller, Trajectory, load_config
from diffdrive_mpc.mpc.hold import Hold
from diffdrive_mpc.sim import make_plant, simulate
from diffdrive_mpc_extras.free_space import MovingDisc, Surroundings
from diffdrive_mpc_monitor.judge import rule_names
from diffdrive_mpc_monitor.rules import load_rules
from studies.cli import app

RULES = load_rules()
SEED = 90_000
"""Of no other drives."""


@pytest.mark.parametrize("fault", ["wrong sign", "never stops", "sees the past", "miswired", "frozen pose"])
def test_what_keeps_all_limits_is_caught_by_what_the_robot_does(fault):
    """Before harm, within the time that is stated; commands were within range and slew all the while."""
    found = faulty_trial(fault, SEED, RULES)
    assert found.rule in rule_names() and found.rule not in ("", "speed", "slew")
    assert 0.0 <= found.after <= FAULTS[fault].stated
    assert found.farthest <= HARM and found.at_rest


def test_a_robot_that_does_not_obey_is_told_of():
    """Commands cannot stop it: a person has to be told."""
    found = faulty_trial("runaway", SEED, RULES)
    assert found.rule == "answer_v" and found.after <= FAULTS["runaway"].stated and not found.at_rest


@pytest.mark.parametrize("seed", [SEED, SEED + 1])
def test_sound_drives_pass(seed):
    found = nominal_trial(seed, RULES)
    assert not found.rule and found.at_rest and found.driven > 5.0


def test_there_are_more_than_twenty_faults_and_each_breaks_something():
    assert sum(held.of == "controller" for held in FAULTS.values()) > 20
    sound = Fault()
    for name, held in FAULTS.items():
        kind = type(held.make(1.0))
        assert any(getattr(kind, method) is not getattr(Fault, method) for method in vars(Fault) if method[0] != "_"), (
            name
        )
        assert kind.__doc__ and held.stated > 0
    command = Sent(1.0, 0.5, 0.1)
    assert sound.sends(command) == [command]


def test_smooth_faults_keep_range_and_slew():
    fault, sent = Fault(), [Sent(0.0, 0.0, 0.0)]
    for k in range(200):
        wanted = (2.0, -3.0) if k < 100 else (-2.0, 3.0)
        fault.went(sent)
        sent = fault.smooth(0.0, *wanted)
        assert abs(sent[0].v) <= RULES.commands.v and abs(sent[0].omega) <= RULES.commands.omega


def test_drives_are_fixed_by_their_seed_and_differ():
    cases = [nominal_case(seed) for seed in range(60)]
    assert cases == [nominal_case(seed) for seed in range(60)]
    for name in ("controller", "model", "trajectory", "surface", "scenario", "sensors"):
        assert len({getattr(case, name) for case in cases}) >= 3, name


def test_the_study_says_what_was_missed(monkeypatch, tmp_path):
    """With rules under which a robot may be anywhere the wrong sign is missed: exit code 1, and the report stands."""
    rules = tmp_path / "blind.yaml"
    values = RULES.model_dump()
    values["path"] |= {"distance": 900.0, "far": 900.0, "heading": 9.0}
    values["returning"] |= {"distance": 900.0}
    rules.write_text(json.dumps(values), encoding="utf-8")
    few = {name: FAULTS[name] for name in ("not a number", "wrong sign")}
    monkeypatch.setattr("studies.monitor.study.FAULTS", few)
    words = ["monitor", "--rules", str(rules), "--seeds", "1", "--hours", "0.01", "--jobs", "1"]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
    assert result.exit_code == 1 and "error: missed or late: wrong sign (1)" in result.stderr
    content = json.loads((tmp_path / "out" / "monitor.json").read_text(encoding="utf-8"))
    rows = {row["fault"]: row for row in content["trials"]}
    assert rows["not a number"]["rule"] == "not_finite" and rows["wrong sign"]["rule"] == ""
    assert sum(row["driven"] for row in content["trials"] if not row["fault"]) >= 36.0
    assert "Faults" in (tmp_path / "out" / "monitor.md").read_text(encoding="utf-8")


class Waits:
    """A sound controller that something makes wait: `happens` is called before each step with the controller and t."""

    def __init__(self, controller, happens):
        self.inner, self.happens, self.late = controller, happens, 0.0

    planned_delay = property(lambda self: self.inner.planned_delay)

    def start(self, reference, t0):
        self.inner.start(reference, t0)

    def step(self, t, measurement):
        hold = self.happens(self.inner, t)
        step = self.inner.step(t, measurement, hold)
        self.late = max(self.late, step.reference_delay)
        return step


def pauses(_, t):
    return Hold("paused") if 3.0 <= t < 10.0 else None


def slows_down(controller, t):
    if t == 0.0:
        controller.limit_speed(0.2)
    elif abs(t - 15.0) < 0.0102:
        controller.limit_speed(None)


def meets_somebody(controller, t):
    """Somebody crosses the path slowly."""
    controller.feature("free_space").set_obstacles(
        Surroundings(discs=[MovingDisc(2.2, 0.08 * t - 0.8, 0.3, 0.0, 0.08)], time=t)
    )


WAITS = {
    "paused": (pauses, {}, 7.0),
    "a speed limit": (slows_down, {}, 5.0),
    "somebody crosses": (meets_somebody, {"free_space.enabled": True}, 6.0),
}


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("name", WAITS)
def test_a_controller_that_waits_on_purpose_is_let_pass_where_it_says_so(name, told, monkeypatch):
    happens, settings, late = WAITS[name]
    if not told:
        monkeypatch.setattr(trial, "_TOLD_AGAIN", math.inf)
    reference = Trajectory.from_waypoints([[0, 0], [5, 0]], speed=0.4)
    controller = Waits(Controller(load_config("ssm", settings)), happens)
    watch = MonitoredController(controller, RULES)
    simulate(watch, make_plant("model:ssm"), reference, extra_time=late + 12.0)
    assert controller.late > late
    assert bool(watch.verdict) is not told


def test_an_alarm_in_a_sound_drive_is_a_complaint():
    found = nominal_trial(SEED, load_rules())
    alarmed = MonitorStudyResult({}, [found.__class__(**{**vars(found), "rule": "off_path"})])
    assert complaint(alarmed) == "1 nominal drives alarmed"
    assert complaint(MonitorStudyResult({}, [found])) == ""
    assert not math.isnan(found.farthest) and np.isfinite(found.fastest)
