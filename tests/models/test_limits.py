"""A limit of a command is found where there is one, however seldom it is reached, and nothing else is taken for one."""

import pytest
from limit_population import drawn_case, judged

from diffdrive_mpc.models.structures.sm import identify_sm


@pytest.mark.parametrize("seed", [2026, 2030])
def test_a_limit_that_is_seldom_reached_is_found(seed):
    case = drawn_case(seed)
    found, close, false = judged(case, identify_sm(case.records).limits)
    assert found and close and not false


@pytest.mark.parametrize(
    ("seed", "odd"), [(2017, "compressed gain"), (2013, "gain of the other channel"), (2040, "slew")]
)
def test_what_is_no_limit_is_not_taken_for_one(seed, odd):
    case = drawn_case(seed)
    assert case.name.endswith(odd)
    assert identify_sm(case.records).limits == {}
