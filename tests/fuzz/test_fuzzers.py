"""Fuzzers are repeatable and bounded, find planted faults, and find none in a short run."""

import json
import math
import os
import signal
import subprocess
import time
from itertools import count

import pytest

from diffdrive_mpc import ConfigError, load_config
from diffdrive_mpc.app.schemas import PACKAGE
from file_kinds import KINDS
from fuzz import configs, runner, yaml_files
from fuzz.case import FaultError, draw, saved_findings
from fuzz.controller import CONFIGS, EXTRAS
from fuzz.core import build_core
from fuzz.fuzzers import FUZZERS
from fuzz.live.judge import Account, Allowed, Heard, faults
from fuzz.runner import Order, inside

FOUND = saved_findings()


@pytest.mark.parametrize(("fuzzer", "mark"), FOUND)
def test_corrected_finding_stays_corrected(fuzzer, mark):
    assert runner.judged(FUZZERS[fuzzer], FOUND[fuzzer, mark]) is None


@pytest.mark.system
def test_core_stays_inside_its_arrays_and_limits(tmp_path):
    """`make fuzz` drives longer."""
    words = [str(build_core(tmp_path)), "2", "6"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    lines = {line.split("  ")[0]: line for line in done.stdout.splitlines()}
    # Maximum sizes were driven, and each kind of end occurred.
    assert "largest, function" in lines
    endings = ("tracking", "reused", "braking", "stopped", "finished", "active set", "backend")
    assert all(any(f"{ending} 0" not in line for line in lines.values()) for ending in endings)


@pytest.mark.parametrize("name", FUZZERS)
def test_case_follows_from_seed_and_number_and_survives_json(name):
    def text(seed, index):
        return json.dumps(draw(FUZZERS[name], seed, index))

    assert text(3, 5) == text(3, 5)
    assert len({text(3, index) for index in range(10)} | {text(4, 5)}) > 5
    assert json.dumps(json.loads(text(3, 5))) == text(3, 5)


@pytest.mark.parametrize("name", ["controller", "references", "yaml"])
def test_quick_fuzzers_find_nothing(name, tmp_path):
    result = runner.run(Order(name, seed=20, first=0, count=12, seconds=120.0), tmp_path)
    assert (result.cases, result.lines) == (12, [])


@pytest.mark.system
def test_steps_of_all_models_keep_the_promises_of_safety(tmp_path):
    """The long form of it is `.ci/long properties`."""
    ran = runner.run(Order("controller", seed=36, first=0, count=130, seconds=300.0), tmp_path)
    assert (ran.cases, ran.lines) == (130, [])
    assert ran.steps > 5000
    drawn = [draw(FUZZERS["controller"], 36, index) for index in range(130)]
    assert {case["config"] for case in drawn} == set(CONFIGS)
    assert all(any(extra.items() <= case["overrides"].items() for case in drawn) for extra in EXTRAS)
    assert {"bound", "tick", "again"} <= {event[0] for case in drawn for event in case["events"]}


def test_step_longer_than_its_sample_time_is_a_finding(monkeypatch):
    fuzzer = type(FUZZERS["controller"])()
    reference = {"kind": "named", "name": "circle"}
    events = [["start", 0, 0.0], ["drive", 3], ["bound", None, -1.0], ["drive", 4]]
    case = {"config": "ssm", "overrides": {}, "terms": [], "references": [reference], "events": events}
    assert runner.judged(fuzzer, case) is None
    assert fuzzer.steps == 7 and 4 <= fuzzer.late <= 7
    assert fuzzer.longest_step > 0.0
    clock = count(step=0.5)
    monkeypatch.setattr(time, "thread_time", lambda: next(clock))
    assert runner.judged(fuzzer, case)[0].startswith("deadline: a step of 500.0 ms in a sample of 20.2 ms")


class Planted:
    """Wrong for lists with a 7, slow for those with an 8, and the death of its process for those with a 9."""

    name, longest, count = "planted", 0.2, 10

    def draw(self, random):
        return [random.randrange(7) for _ in range(20)] + [self.worst]

    def check(self, case):
        if 7 in case:
            raise FaultError(f"seven: at {case.index(7)}")
        if 8 in case:
            time.sleep(5.0)
        if 9 in case:
            os.kill(os.getpid(), signal.SIGKILL)


def lived(worst, tmp_path):
    fuzzer = Planted()
    fuzzer.worst = worst
    inside(fuzzer, Order("planted", 1, 4, 3, 60.0), tmp_path / "report", tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "report").read_text().splitlines()]
    return [line["found"] for line in lines if "found" in line]


@pytest.fixture
def gentle(monkeypatch):
    """The bounds of the process are not those of the tests' process."""
    monkeypatch.setattr(runner.resource, "setrlimit", lambda *_: None)
    monkeypatch.setattr(runner.logging, "disable", lambda *_: None)


def test_finding_is_saved_and_reported_once_with_its_command(gentle, tmp_path):
    findings = lived(7, tmp_path)
    assert len(findings) == 1
    assert 'make fuzz FUZZ="planted --seed 1 --only 4"' in findings[0]
    (((fuzzer, _), case),) = saved_findings(tmp_path).items()
    assert fuzzer == "planted" and case[-1] == 7


def test_hang_is_a_finding(gentle, tmp_path):
    (finding,) = lived(8, tmp_path)
    assert "hangs: it takes longer than 0.2 s" in finding


def test_configurations_cover_the_schema_and_half_are_valid():
    from random import Random

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


LIMITS = Allowed(0.0, (1.0, 2.0), (0.04, 0.12))


def driven(*speeds, **more):
    return Account(commands=[Heard(0.02 * i, v, 0.0, i + 1) for i, v in enumerate(speeds)], allowed=[LIMITS], **more)


@pytest.mark.parametrize(
    ("account", "word"),
    [
        (driven(0.0, 0.04, 0.08), ""),
        (driven(0.0, 0.04, math.nan), "not finite"),
        (driven(0.98, 1.02), "limits"),
        (driven(0.0, 0.05), "slew"),
        (driven(0.5, 0.0), "slew"),
        (driven(0.5, 0.0, modes=[(0.02, "STOPPED: no tick for 3 s")]), ""),
        (driven(0.5, 0.0, requested=[0.0]), ""),
        (driven(0.5, 0.1, requested=[0.0]), "slew"),
        (driven(0.04, 0.0, zero=[(-1.0, 1.0, "lost")]), "zero"),
        (driven(0.0, 0.0, zero=[(-1.0, 1.0, "lost")]), ""),
        (driven(0.0, 0.0, active=[(0.0, 2.0)]), "gap"),
        # No ticks are due while their clock stands.
        (driven(0.0, 0.0, active=[(0.0, 2.0)], stood=[(0.1, 1.9)]), ""),
        (driven(0.0, 0.0, active=[(0.0, 4.0)], stood=[(0.1, 1.9)]), "gap"),
        (Account(commands=[Heard(0.0, 0.0, 0.0, 1), Heard(0.02, 0.08, 0.0, 3)], allowed=[LIMITS]), ""),
        (Account(commands=[Heard(0.0, 0.0, 0.0, 1, others=True)], allowed=[LIMITS]), "beside"),
        # A limit that was tightened is reached at slew.
        (
            Account(
                commands=[Heard(1.0 + 0.02 * i, 0.9 - 0.04 * i, 0.0, i + 1) for i in range(10)],
                allowed=[LIMITS, Allowed(0.1, (0.1, 2.0), (0.04, 0.12))],
            ),
            "",
        ),
    ],
)
def test_judge_finds_broken_promises_of_live_commands(account, word):
    lines = faults(account)
    assert bool(lines) == bool(word)
    assert word in " ".join(lines)
