"""Searches of the product cut to a few steps, for tests of what comes before and after them."""

from contextlib import contextmanager

import pytest

from diffdrive_mpc.app.identification import trial_drives
from diffdrive_mpc_extras.excitation import model_excitation
from diffdrive_mpc_extras.hybrids import finding as hybrid
from diffdrive_mpc_extras.twin import fitting

SHORTER = (
    (model_excitation, "model_excitation_settings", {"population": 6, "generations": 1}),
    (hybrid, "hybrid_settings", {"units": 6, "decays": (1e-3,), "most_steps": 80}),
    (fitting, "twin_settings", {"evaluations": (2, 3), "refined": 1}),
)
"""Module, its function that reads the settings, and what is changed in them."""


@contextmanager
def quick_settings():
    """Search for drives, train hybrids and fit twins with `SHORTER`, and try what was identified along one path."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, changes in SHORTER:
            settings = getattr(module, name)().model_copy(update=changes)
            patch.setattr(module, name, lambda settings=settings: settings)
        patch.setattr(trial_drives, "PATHS", ("circle",))
        yield
