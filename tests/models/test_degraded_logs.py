"""Logs made worse on purpose: the cause is named with its remedy, nothing else is, and nonsense is refused."""

import pytest
from degraded_logs import CASES, FIRST_TEN, logs_of, verdict

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.logs import read_log
from diffdrive_mpc.models.logs.diagnosis import compare_logs

UNTOLD = {"asphalt: command +0.3 s"}
"""Commands stamped late on a robot whose dead time is longer than that: it merely looks quicker than it is."""


def judged(case, folder):
    """Findings on the logs of a case, or the line that refuses them."""
    try:
        paths, mapping = logs_of(case, folder)
        logs = [read_log(path, mapping) for path in paths]
    except ConfigError as error:
        assert "\n" not in str(error)
        return [], str(error)
    return [*(finding for log in logs for finding in log.findings), *compare_logs(logs)], None


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_the_cause_is_named_and_no_other(case, tmp_path):
    findings, raised = judged(case, tmp_path)
    said = [f"{finding.severity}: {finding}" for finding in findings] + [raised]
    assert verdict(case, findings, raised) == ("missed" if case.name in UNTOLD else "right"), said
    refused = raised is not None or any(finding.severity == "error" for finding in findings)
    if case.refused is not None and case.name not in UNTOLD:
        assert refused == case.refused, said


def test_the_suite_is_large_enough():
    assert len({case.name for case in CASES}) == len(CASES)
    assert len(FIRST_TEN) == 10
    assert len(CASES) >= 120
