"""Short search settings, for tests that do not check the quality of the search results."""

from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec

import pytest

from diffdrive_mpc.app.identification import trial_drives

SHORT_SETTINGS = {
    "diffdrive_mpc_extras.excitation.model_excitation": (
        "model_excitation_settings",
        {"population": 6, "generations": 1},
    ),
    "diffdrive_mpc_extras.hybrids.finding": ("hybrid_settings", {"units": 6, "decays": (1e-3,), "max_steps": 80}),
    "diffdrive_mpc_extras.twin.fitting": ("twin_settings", {"evaluations": (2, 3), "refined": 1}),
}
"""Function that reads the settings, and changed values, by module of an optional package."""


@contextmanager
def quick_settings():
    """Search, train and fit with `SHORT_SETTINGS`, and try an identified model along one path."""
    with pytest.MonkeyPatch.context() as patch:
        for module_name, (name, changes) in SHORT_SETTINGS.items() if find_spec("diffdrive_mpc_extras") else ():
            module = import_module(module_name)
            settings = getattr(module, name)().model_copy(update=changes)
            patch.setattr(module, name, lambda settings=settings: settings)
        patch.setattr(trial_drives, "PATHS", ("circle",))
        yield
