"""Logs with artificial defects: findings name the cause, and the advice corrects it."""

from pathlib import Path

import numpy as np
import pytest
from degraded_logs import (
    CASES,
    CAUSES,
    DEGREES,
    FAULTS,
    NO_POSE,
    READINGS,
    REAL_BASES,
    RPM,
    TIMES,
    Case,
    changed,
    from_the_middle,
    held,
    in_bursts,
    logs_of,
    robot,
    rounded,
    scaled,
    shifted,
    swapped,
    verdict,
)
from scipy.signal import lfilter

from diffdrive_mpc import ConfigError
from diffdrive_mpc.models.identification.advice import LogSelection, advise, drop_rejected
from diffdrive_mpc.models.identification.fit.sensors import find_corrections
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.diagnosis import compare_logs
from diffdrive_mpc.models.logs.mapping import LogMapping, load_mapping
from diffdrive_mpc.models.logs.mapping_changes import apply_changes, format_mapping, stated_changes
from diffdrive_mpc.models.logs.record import Finding, MappingChange, UnsoundLogError

SKIDDING = {"seed": 61, "seconds": 60.0, "skid": 0.35, "lag": 0.2}
SLOW = {"seed": 62, "seconds": 60.0, "lag": 0.4, "gain": (0.8, 1.2), "dead_time": 0.2}
QUICK = {"seed": 63, "seconds": 60.0, "lag": 0.05, "dead_time": 0.02}


def simulated_case(robot_, change, mapping=str):
    return Case("simulated", "", lambda _, base: change(robot(**robot_), base), mapping=mapping)


def gyro_and_sides(columns, base):
    return scaled(gyro=DEGREES)(swapped("left", "right")(columns, base), base)


def slow_body(lag):
    """Delay the yaw rate of the body relative to the wheels, as on ice."""
    decay = np.exp(-0.02 / lag)
    return changed(lambda rate: lfilter([1 - decay], [1, -decay], rate), "gyro")


def findings_of(paths, mapping):
    try:
        return [finding for path in paths for finding in read_log(path, mapping).findings]
    except UnsoundLogError as error:
        return error.findings


def advice_on(case, folder):
    paths, mapping = logs_of(case, folder)
    return advise(LogSelection(tuple(paths), (), mapping, 0.6), findings_of(paths, mapping))


CORRECTED = {
    "gyro late": (simulated_case(SKIDDING, shifted("gyro", 0.3)), {"gyro delay"}),
    "gyro early": (simulated_case(QUICK, shifted("gyro", -0.3)), {"gyro delay"}),
    "encoders late": (simulated_case(SLOW, shifted("encoders", 0.3)), {"encoders delay"}),
    "pose late": (simulated_case(QUICK, shifted("pose", 0.3)), {"pose delay"}),
    "commands late": (simulated_case(SKIDDING, shifted("command", 0.4)), {"command delay"}),
    "encoders in rpm": (simulated_case(SLOW, scaled(encoders=RPM)), {"encoders left.unit", "encoders right.unit"}),
    "commands in mm/s": (simulated_case(SKIDDING, scaled(v_ref=1000.0)), {"command v.unit"}),
    "gyro upside down": (simulated_case(QUICK, scaled(gyro=-1.0)), {"gyro yaw_rate.sign"}),
    "left wheel reversed": (simulated_case(SLOW, scaled(left=-1.0)), {"encoders left.sign"}),
    "pose mirrored": (simulated_case(SKIDDING, scaled(y=-1.0)), {"pose y.sign"}),
    "gyro in deg/s, sides swapped": (simulated_case(QUICK, gyro_and_sides), {"encoders sides", "gyro yaw_rate.unit"}),
    "gyro held": (simulated_case(QUICK, changed(held(5), "gyro")), {"gyro held"}),
    "milliseconds": (simulated_case(SKIDDING, scaled(t=1000.0)), {"time unit"}),
    "stamps in bursts, confirmed by poses": (simulated_case(SKIDDING, changed(in_bursts, "t")), {"time sample_time"}),
    "yaw in degrees": (simulated_case(SLOW, scaled(theta=DEGREES)), {"pose theta.unit"}),
    "encoders half from the middle on": (simulated_case(QUICK, from_the_middle("encoders", 0.5)), {"log times"}),
}


QUICK_CASES = ("commands late", "encoders in rpm", "gyro upside down", "gyro held", "milliseconds")
QUICK_CASES += ("gyro in deg/s, sides swapped",)
"""Corrected logs of each kind of change that `make test` runs; the system suite runs all."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK_CASES else pytest.mark.system) for name in CORRECTED]
)
def test_advised_change_predicts_better_and_repairs_the_log(tmp_path, name):
    case, expected = CORRECTED[name]
    advice = advice_on(case, tmp_path)
    assert {f"{change.stream} {change.key}" for change in advice.changes} == expected
    assert advice.after.fit.min() > 70
    if advice.before is not None:
        assert (advice.after.fit >= advice.before.fit - 0.5).all()
        gains = [(advice.after.fit - advice.before.fit).max(), advice.after.agreement - advice.before.agreement]
        assert max(gains) > 1 or name == "yaw in degrees"
    advice.write(tmp_path)
    corrected = tmp_path / "fixed.yaml"
    assert load_mapping(corrected) == advice.mapping
    assert not any(finding.severity == "error" for finding in read_log(tmp_path / "log0.csv", corrected).findings)


NOT_CORRECTED = {
    "stamps in bursts, without poses": simulated_case(SKIDDING, changed(in_bursts, "t"), NO_POSE),
    "time reversed": simulated_case(SKIDDING, changed(lambda time: time[::-1], "t")),
    # Multiples of 0.25 s, the resolution of 32-bit floats some weeks after their epoch.
    "stamps of coarse floats": simulated_case(SKIDDING, changed(lambda time: np.round(4.0 * time) / 4.0, "t"), NO_POSE),
    "a body slower than its wheels": simulated_case({"seed": 64, "seconds": 60.0}, slow_body(0.5), NO_POSE),
    "coarse encoders that are not held": simulated_case(
        {"seed": 65, "seconds": 60.0, "lag": 0.2}, changed(rounded(2.0), "encoders")
    ),
}


@pytest.mark.parametrize("name", NOT_CORRECTED)
def test_change_without_better_prediction_is_not_advised(tmp_path, name):
    paths, mapping = logs_of(NOT_CORRECTED[name], tmp_path)
    findings = findings_of(paths, mapping)
    assert advise(LogSelection(tuple(paths), (), mapping, 0.6), findings) is None
    assert "in the mapping" not in " ".join(map(str, drop_rejected(findings, None)))


def test_late_response_of_the_robot_is_not_treated_as_shifted_commands(tmp_path):
    findings = findings_of(*logs_of(simulated_case(QUICK, shifted("command", -0.5)), tmp_path))
    assert [finding.kind for finding in findings] == ["time shift"]
    assert not findings[0].changes


def test_log_without_proposals_is_not_read_again():
    selection = LogSelection((Path("there_is_none.csv"),), (), None, 0.6)
    assert advise(selection, [Finding("gap", "note", "", "")], lambda _: pytest.fail("a change was tried")) is None


def test_topic_changes_are_applied_if_the_mapping_of_topics_supports_them():
    bag = LogMapping.model_validate({"topics": {"odometry": "/odom", "imu": {"topic": "/imu", "sign": -1}}})
    changes = [MappingChange("gyro", "yaw_rate.sign", -1), MappingChange("command", "on_change", True)]
    changed_mapping = apply_changes(bag, stated_changes(bag, changes))
    assert changed_mapping.topics.imu.sign == 1
    assert changed_mapping.topics.command.on_change
    assert "/cmd_vel" in format_mapping(changed_mapping)
    assert not stated_changes(bag, [MappingChange("encoders", "left.unit", "rpm")])


UNDETECTED = {"asphalt: command +0.3 s"}
"""Commands with late stamps: they are equivalent to a shorter dead time of the robot."""


def diagnose(case, folder):
    """Return the findings for the logs of a case, or the message of the error if the logs are refused."""
    try:
        paths, mapping = logs_of(case, folder)
        logs = [read_log(path, mapping) for path in paths]
    except ConfigError as error:
        assert "\n" not in str(error)
        return [], str(error)
    return [*(finding for log in logs for finding in log.findings), *compare_logs(logs)], None


def marks_of(case):
    """Return the markers of a case: `real_logs` for bases from real logs, `system` for most simulated bases."""
    system = case in (*TIMES, *READINGS, *CAUSES) and case.base not in REAL_BASES
    return [pytest.mark.real_logs] * (case.base in REAL_BASES) + [pytest.mark.system] * system


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name, marks=marks_of(case)) for case in CASES])
def test_findings_name_only_the_true_cause(case, tmp_path):
    findings, error = diagnose(case, tmp_path)
    messages = [f"{finding.severity}: {finding}" for finding in findings] + [error]
    assert verdict(case, findings, error) == ("missed" if case.name in UNDETECTED else "right"), messages
    is_refused = error is not None or any(finding.severity == "error" for finding in findings)
    if case.refused is not None and case.name not in UNDETECTED:
        assert is_refused == case.refused, messages


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in FAULTS])
def test_findings_name_the_fault_of_a_robot(case, tmp_path):
    paths, mapping = logs_of(case, tmp_path)
    log = read_log(paths[0], mapping)
    findings = find_corrections(log.name, log.records, mapping).merged(log.findings)
    assert verdict(case, findings) == "right", list(map(str, findings))
