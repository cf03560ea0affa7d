"""Fixtures of the bench's tests."""

import pytest
from bench_parts import quick_outcome

from diffdrive_mpc.bench.run_row import RunOutcome


@pytest.fixture(scope="session")
def outcome() -> RunOutcome:
    """Return the outcome of a drive along the cane on the plant of the controller's model."""
    return quick_outcome(trajectory="cane")
