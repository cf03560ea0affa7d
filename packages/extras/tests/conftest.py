"""Set-up of the tests: one hypothesis profile, one thread for each numerical library, and short searches."""

import os
from types import SimpleNamespace

import pytest
from hypothesis import settings

settings.register_profile("reproducible", deadline=None, derandomize=True, print_blob=False, max_examples=25)
settings.load_profile("reproducible")
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
# Tables are as wide as in a pipe.
os.environ.pop("COLUMNS", None)


@pytest.fixture
def one_process(monkeypatch):
    """Commands without --jobs use one process: to start others takes seconds."""
    from diffdrive_mpc.bench import runner

    monkeypatch.setattr(runner, "os", SimpleNamespace(**vars(os) | {"sched_getaffinity": lambda process: {0}}))


@pytest.fixture
def quick_search():
    """Searches for drives, training of networks and fits of twins take a few steps."""
    from quick_settings import quick_settings

    with quick_settings():
        yield
