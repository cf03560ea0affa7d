"""Tests of the fuzzers: short runs, and detection of planted faults."""

import json
import math
import time
from itertools import count
from random import Random

import pytest

from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.app.schemas import PACKAGE
from file_kinds import KINDS
from fuzz import configs, yaml_files
from fuzz.case import FaultError, draw, saved_findings
from fuzz.controller import CONFIGS, EXTRAS, ControllerFuzzer
from fuzz.core import build_core, drive
from fuzz.fuzzers import FUZZERS
from fuzz.judge import CONFIG, EventLog, ReceivedCommand, faults
from fuzz.runner import check_within_bounds, search


@pytest.mark.system
def test_core_satisfies_the_bounds_of_arrays_and_commands(tmp_path):
    """`make fuzz` runs a longer version."""
    assert drive(build_core(tmp_path), 2, 16) > 500


@pytest.mark.parametrize("name", FUZZERS)
def test_cases_differ_and_are_unchanged_by_json(name):
    cases = [json.dumps(draw(FUZZERS[name], 3, index)) for index in range(10)]
    assert len(set(cases)) > 5
    assert json.dumps(json.loads(cases[5])) == cases[5]


@pytest.mark.parametrize(("name", "cases"), [("controller", 25), ("references", 12), ("yaml", 12), ("logs", 1)])
def test_fixed_findings_stay_fixed_and_short_runs_find_no_fault(name, cases):
    checked = []
    search(FUZZERS[name], "20", cases, on_case=checked.append)
    fixed = [case for (fuzzer, _), case in saved_findings().items() if fuzzer == name]
    assert len(checked) == len(fixed) + cases and len(fixed) > 0


@pytest.mark.long
def test_steps_of_all_models_satisfy_the_safety_guarantees():
    """`.ci/long properties` runs more cases."""
    fuzzer, cases = ControllerFuzzer(), []
    search(fuzzer, "36", 130, on_case=cases.append)
    assert fuzzer.steps > 5000
    assert {case["config"] for case in cases} == set(CONFIGS)
    assert all(any(extra.items() <= case["overrides"].items() for case in cases) for extra in EXTRAS)
    assert {"bound", "tick", "again"} <= {event[0] for case in cases for event in case["events"]}


def test_step_longer_than_its_sample_time_is_a_finding(monkeypatch):
    fuzzer = ControllerFuzzer()
    reference = {"kind": "named", "name": "circle"}
    events = [["start", 0, 0.0], ["drive", 3], ["bound", None, -1.0], ["drive", 4]]
    case = {"config": "ssm", "overrides": {}, "terms": [], "references": [reference], "events": events}
    check_within_bounds(fuzzer, case)
    assert fuzzer.steps == 7 and 4 <= fuzzer.late <= 7
    assert fuzzer.longest_step > 0.0
    clock = count(step=0.5)
    monkeypatch.setattr(time, "thread_time", lambda: next(clock))
    with pytest.raises(FaultError, match="deadline: a step of 500.0 ms in a sample of 20.2 ms"):
        check_within_bounds(fuzzer, case)


def test_configurations_cover_the_schema_and_most_are_valid():
    overrides = [configs.draw_overrides(Random(str(i))) for i in range(200)]
    assert len({key for values in overrides for key in values}) > 100
    valid_count = 0
    for values in overrides:
        try:
            load_config("ssm", values)
        except ConfigError:
            continue
        valid_count += 1
    assert valid_count > 100


def test_files_of_every_kind_of_the_root_are_fuzzed():
    assert all(yaml_files.seeds(kind) for kind in yaml_files.LOADERS)
    kinds = {name for name, kind in KINDS.items() if kind.folder.is_relative_to(PACKAGE)}
    assert kinds <= set(yaml_files.LOADERS)


V, STEP = CONFIG.limits.v, CONFIG.limits.v_braking * CONFIG.sample_time


def log_of_speeds(*speeds, **fields):
    return EventLog([ReceivedCommand(0.02 * i, v, 0.0, i + 1) for i, v in enumerate(speeds)], **fields)


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (log_of_speeds(0.0, STEP, 2 * STEP), ""),
        (log_of_speeds(0.0, STEP, math.nan), "not finite"),
        (log_of_speeds(V - 0.01, V + 0.01), "limits"),
        (log_of_speeds(0.0, 1.1 * STEP), "slew"),
        (log_of_speeds(0.5, 0.0), "slew"),
        (log_of_speeds(0.5, 0.0, modes=[(0.02, "STOPPED: no tick for 3 s")]), ""),
        (log_of_speeds(0.5, 0.0, requested=[0.0]), ""),
        (log_of_speeds(0.5, 0.1, requested=[0.0]), "slew"),
        (log_of_speeds(STEP, 0.0, zero=[(-1.0, 1.0, "lost")]), "zero"),
        (log_of_speeds(0.0, 0.0, zero=[(-1.0, 1.0, "lost")]), ""),
        (EventLog([ReceivedCommand(0.0, 0.0, 0.0, 1), ReceivedCommand(0.02, 2 * STEP, 0.0, 3)]), ""),
    ],
)
def test_judge_finds_violations_in_live_commands(log, message):
    lines = faults(log)
    assert bool(lines) == bool(message)
    assert message in " ".join(lines)
