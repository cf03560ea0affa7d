"""What fuzzers once found, and what was mended since, once more."""

import pytest

from fuzz.case import saved_findings
from fuzz.fuzzers import FUZZERS
from fuzz.runner import judged

FOUND = saved_findings()


@pytest.mark.parametrize(("fuzzer", "mark"), FOUND)
def test_what_was_found_once_is_mended(fuzzer, mark):
    assert judged(FUZZERS[fuzzer], FOUND[fuzzer, mark]) is None


def test_there_is_something_to_replay():
    assert len(FOUND) > 5
