"""The monitor behind real controllers on the simulated robot: some faults, some fault-free drives, and the report."""

import json

import pytest
from studies.monitor.faults import FAULTS
from studies.monitor.trial import HARM, faulty_trial, nominal_trial
from typer.testing import CliRunner

from diffdrive_mpc_monitor.judge import rule_names
from diffdrive_mpc_monitor.rules import load_rules
from studies.cli import app

pytestmark = pytest.mark.system

RULES = load_rules()
SEED = 90_000
"""Seed that is not used elsewhere."""


@pytest.mark.parametrize("fault", ["wrong sign", "never stops", "sees the past", "miswired", "frozen pose"])
def test_fault_within_all_limits_is_detected_by_the_motion_of_the_robot(fault):
    """A rule trips before harm and within the stated time; commands stay within range and slew."""
    trial = faulty_trial(fault, SEED, RULES)
    assert trial.rule in rule_names() and trial.rule not in ("", "speed", "slew")
    assert 0.0 <= trial.after <= FAULTS[fault].stated
    assert trial.farthest <= HARM and trial.at_rest


def test_disobedient_robot_is_reported():
    """Commands cannot stop the robot: a person has to be notified."""
    trial = faulty_trial("runaway", SEED, RULES)
    assert trial.rule == "answer_v" and trial.after <= FAULTS["runaway"].stated and not trial.at_rest


@pytest.mark.parametrize("seed", [SEED, SEED + 1])
def test_fault_free_drive_passes(seed):
    trial = nominal_trial(seed, RULES)
    assert not trial.rule and trial.at_rest and trial.driven > 5.0


def test_study_reports_missed_faults(monkeypatch, tmp_path):
    """With rules that permit any position, the wrong sign is missed: exit code 1, and the report is written."""
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
