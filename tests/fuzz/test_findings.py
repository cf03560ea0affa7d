"""What fuzzers once found, and what was mended since, once more."""

import pytest

from fuzz.case import load_case, saved_findings
from fuzz.fuzzers import FUZZERS
from fuzz.runner import judged

FOUND = saved_findings()


@pytest.mark.parametrize(("fuzzer", "path"), FOUND, ids=[f"{fuzzer}-{path.stem}" for fuzzer, path in FOUND])
def test_what_was_found_once_is_mended(fuzzer, path):
    assert judged(FUZZERS[fuzzer], load_case(path)) is None


def test_there_is_something_to_replay():
    assert len(FOUND) > 5
