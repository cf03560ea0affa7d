"""Monitor with faulty controllers on the simulated robot: detection of faults by the motion of the robot."""

import pytest
from studies.monitor.faults import FAULTS
from studies.monitor.trial import HARM, faulty_trial

from diffdrive_mpc_monitor.judge import rule_names
from diffdrive_mpc_monitor.rules import load_rules

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


def test_robot_that_ignores_commands_is_reported():
    """Commands cannot stop the robot: a person has to be notified."""
    trial = faulty_trial("runaway", SEED, RULES)
    assert trial.rule == "answer_v" and trial.after <= FAULTS["runaway"].stated and not trial.at_rest
