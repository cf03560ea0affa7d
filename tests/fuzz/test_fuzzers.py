"""Fuzzers find planted faults, and none in a short run."""

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
from fuzz.case import draw, saved_findings
from fuzz.controller import CONFIGS, EXTRAS, ControllerFuzzer
from fuzz.core import build_core, drive
from fuzz.fuzzers import FUZZERS
from fuzz.judge import CONFIG, Account, Heard, faults
from fuzz.runner import judged, search


@pytest.mark.system
def test_core_stays_inside_its_arrays_and_limits(tmp_path):
    """`make fuzz` drives longer."""
    assert drive(build_core(tmp_path), 2, 16) > 500


@pytest.mark.parametrize("name", FUZZERS)
def test_cases_differ_and_survive_json(name):
    cases = [json.dumps(draw(FUZZERS[name], 3, index)) for index in range(10)]
    assert len(set(cases)) > 5
    assert json.dumps(json.loads(cases[5])) == cases[5]


@pytest.mark.parametrize(("name", "cases"), [("controller", 25), ("references", 12), ("yaml", 12), ("logs", 1)])
def test_corrected_findings_stay_corrected_and_quick_fuzzers_find_nothing(name, cases):
    checked = []
    search(FUZZERS[name], "20", cases, on_case=checked.append)
    corrected = [case for (fuzzer, _), case in saved_findings().items() if fuzzer == name]
    assert len(checked) == len(corrected) + cases and len(corrected) > 0


@pytest.mark.system
def test_steps_of_all_models_keep_the_promises_of_safety():
    """The long form of it is `.ci/long properties`."""
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
    assert judged(fuzzer, case) is None
    assert fuzzer.steps == 7 and 4 <= fuzzer.late <= 7
    assert fuzzer.longest_step > 0.0
    clock = count(step=0.5)
    monkeypatch.setattr(time, "thread_time", lambda: next(clock))
    assert "deadline: a step of 500.0 ms in a sample of 20.2 ms" in judged(fuzzer, case)


def test_configurations_cover_the_schema_and_half_are_valid():
    drawn = [configs.draw_overrides(Random(str(i))) for i in range(200)]
    assert len({key for values in drawn for key in values}) > 100
    good = 0
    for values in drawn:
        try:
            load_config("ssm", values)
        except ConfigError:
            continue
        good += 1
    assert good > 100


def test_files_of_every_kind_of_the_root_are_fuzzed():
    assert all(yaml_files.seeds(kind) for kind in yaml_files.DOORS)
    kinds = {name for name, kind in KINDS.items() if kind.folder.is_relative_to(PACKAGE)}
    assert kinds <= set(yaml_files.DOORS)


V, STEP = CONFIG.limits.v, CONFIG.limits.v_braking * CONFIG.sample_time


def driven(*speeds, **more):
    return Account([Heard(0.02 * i, v, 0.0, i + 1) for i, v in enumerate(speeds)], **more)


@pytest.mark.parametrize(
    ("account", "word"),
    [
        (driven(0.0, STEP, 2 * STEP), ""),
        (driven(0.0, STEP, math.nan), "not finite"),
        (driven(V - 0.01, V + 0.01), "limits"),
        (driven(0.0, 1.1 * STEP), "slew"),
        (driven(0.5, 0.0), "slew"),
        (driven(0.5, 0.0, modes=[(0.02, "STOPPED: no tick for 3 s")]), ""),
        (driven(0.5, 0.0, requested=[0.0]), ""),
        (driven(0.5, 0.1, requested=[0.0]), "slew"),
        (driven(STEP, 0.0, zero=[(-1.0, 1.0, "lost")]), "zero"),
        (driven(0.0, 0.0, zero=[(-1.0, 1.0, "lost")]), ""),
        (Account([Heard(0.0, 0.0, 0.0, 1), Heard(0.02, 2 * STEP, 0.0, 3)]), ""),
    ],
)
def test_judge_finds_broken_promises_of_live_commands(account, word):
    lines = faults(account)
    assert bool(lines) == bool(word)
    assert word in " ".join(lines)
