"""The language checker of `make lint`: rules for Python and C, and its list of exceptions."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
_SPEC = importlib.util.spec_from_file_location("language", ROOT / ".ci" / "language.py")
language = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(language)

PYTHON = '''"""Path tracking."""

import numpy as given

RATE = 20.0
"""How often a tick runs [Hz]."""


class Robot:
    """Of the simulated robot."""

    other: float = 0.0

    def drive(self, at, *, speed):
        """The speed in m/s."""
        self.kept = speed
        return [one for one in at]

    @property
    def pose(self):
        """Pose in the world frame."""
        return self.x.told

    def name(self):
        """Name of the robot."""

    def stop(self):
        """Stop, at the limit of the slew rate."""
        call(other=1)


def test_robot_drives():
    """A robot drives."""


def there():
    """Whether the robot is present."""
'''
C = """/* What the filter knows. */
static int own(const double *seen, int count)
{
    double a = 0.0, found = 1.0; // how far
    const char *text = "/* of */ int told;";
    /* Sum over rows. */
    return given;
}
"""


PYTHON_VIOLATIONS = """3 name given; 6 opening How often a; 10 opening Of the simulated; 12 name other; 14 name at; \
15 verb The speed in; 16 name kept; 17 name one; 25 verb Name of the; 36 name there; 37 opening Whether the robot"""
C_VIOLATIONS = "1 opening What the filter; 2 name own; 2 name seen; 4 name found; 4 opening how far"


@pytest.mark.parametrize(
    ("check", "source", "expected"),
    [("python_violations", PYTHON, PYTHON_VIOLATIONS), ("c_violations", C, C_VIOLATIONS)],
)
def test_violations_of_a_source(check, source, expected):
    violations = sorted(getattr(language, check)(source))
    assert "; ".join(" ".join(map(str, violation)) for violation in violations) == expected
