"""The language checker of `make lint`: rules for Python and C, and its list of exceptions."""

import importlib.util
import subprocess
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


@pytest.mark.parametrize(
    ("check", "source", "expected"),
    [
        (
            "python_violations",
            PYTHON,
            [
                (3, "name", "given"),
                (6, "opening", "How often a"),
                (10, "opening", "Of the simulated"),
                (12, "name", "other"),
                (14, "name", "at"),
                (15, "verb", "The speed in"),
                (16, "name", "kept"),
                (17, "name", "one"),
                (25, "verb", "Name of the"),
                (36, "name", "there"),
                (37, "opening", "Whether the robot"),
            ],
        ),
        (
            "c_violations",
            C,
            [
                (1, "opening", "What the filter"),
                (2, "name", "own"),
                (2, "name", "seen"),
                (4, "name", "found"),
                (4, "opening", "how far"),
            ],
        ),
    ],
)
def test_violations_of_a_source(check, source, expected):
    assert sorted(getattr(language, check)(source)) == expected


@pytest.fixture
def tree(tmp_path):
    """A repository with one file whose single violation is listed."""
    (tmp_path / ".ci").mkdir()
    (tmp_path / "a.py").write_text("one = 1\n")
    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "a.py"], cwd=tmp_path, check=True)
    assert language.main(tmp_path, ["--update", "--allow-growth"]) == 0
    assert language.main(tmp_path, []) == 0
    return tmp_path


def test_new_violation_fails_with_its_line(tree, capsys):
    (tree / "a.py").write_text("one = 1\nown = 2\n")
    assert language.main(tree, []) == 1
    assert capsys.readouterr().out.splitlines() == [
        "a.py:1: 'one' must not be used as a name; use a noun of the field",
        "a.py:2: 'own' must not be used as a name; use a noun of the field",
        "a.py: 1 violations of rule 'name' are listed; correct 1 of those above",
    ]


def test_update_refuses_a_higher_total(tree, capsys):
    listed = (tree / language.EXCEPTIONS).read_text()
    (tree / "a.py").write_text("one = 1\nown = 2\n")
    assert language.main(tree, ["--update"]) == 1
    assert "not updated: 1 more of rule 'name'" in capsys.readouterr().err
    assert (tree / language.EXCEPTIONS).read_text() == listed


def test_corrected_violation_must_leave_the_list(tree, capsys):
    (tree / "a.py").write_text("count = 1\n")
    assert language.main(tree, []) == 1
    assert "lists 1 more of rule 'name' than exist: python .ci/language.py --update" in capsys.readouterr().out
    assert language.main(tree, ["--update"]) == 0
    assert language.main(tree, []) == 0
    assert (tree / language.EXCEPTIONS).read_text().splitlines()[1:] == []


def test_moved_file_keeps_its_exceptions_after_an_update(tree):
    subprocess.run(["git", "mv", "a.py", "b.py"], cwd=tree, check=True)
    assert language.main(tree, []) == 1
    assert language.main(tree, ["--update"]) == 0
    assert (tree / language.EXCEPTIONS).read_text().splitlines()[1:] == ["b.py name=1"]
