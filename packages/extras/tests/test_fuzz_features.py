"""Controllers with features keep the promises of docs/safety.md in random lives."""

from pathlib import Path

import pytest
from fuzz_features import FEATURES, FeatureFuzzer

from fuzz.case import draw, saved_findings
from fuzz.runner import judged

FINDINGS = saved_findings(Path(__file__).with_name("fuzz_findings"))


def test_drawn_cases_keep_what_is_promised():
    fuzzer = FeatureFuzzer()
    cases = [draw(fuzzer, 30, index) for index in range(60)]
    assert [judged(fuzzer, case) for case in cases] == [None] * len(cases)
    assert all(any(extra.items() <= case["overrides"].items() for case in cases) for extra in FEATURES)
    assert "see" in {event[0] for case in cases for event in case["events"]}
    assert fuzzer.steps > 2000


@pytest.mark.parametrize("key", FINDINGS)
def test_earlier_finding_is_mended(key):
    assert judged(FeatureFuzzer(), FINDINGS[key]) is None


def test_there_are_findings_to_replay():
    assert len(FINDINGS) > 5
