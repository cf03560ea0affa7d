"""Size budgets of the repository: code lines per area and tracked files."""

import subprocess
from functools import cache
from pathlib import Path

import pytest
import yaml

import code_lines

BUDGET_FILE = Path(__file__).with_name("size_budget.yaml")
BUDGETS = yaml.safe_load(BUDGET_FILE.read_text(encoding="utf-8"))


@cache
def current_sizes():
    """Count the sizes of this tree, which takes seconds."""
    return code_lines.sizes()


def measured_sizes(sizes):
    """Return the measured number for each name of the budget file: code lines by area, and `files`."""
    return {name: size.lines for name, size in sizes.items() if name != "all files"} | {
        "files": sizes["all files"].files
    }


def limits(budgets):
    return budgets["lines"] | {"files": budgets["files"]}


def excesses(sizes, budgets):
    """Return one line per area that exceeds its budget or has none."""
    numbers, maxima = measured_sizes(sizes), limits(budgets)
    return [
        f"{name}: {number} {unit(name)} exceed the budget of {maxima.get(name, 0)} by {number - maxima.get(name, 0)}; "
        f"remove code, or raise the budget in {BUDGET_FILE.name} in a separate commit that states the reason"
        for name, number in numbers.items()
        if number > maxima.get(name, 0)
    ]


def loose_budgets(sizes, budgets):
    """Return one line per budget that exceeds its measured size by more than its margin, and its aim."""
    numbers, maxima, aims = measured_sizes(sizes), limits(budgets), budgets["aims"]
    tight = {name: int(1.02 * numbers.get(name, 0)) + (10 if name == "files" else 100) for name in maxima}
    return [
        f"{name}: the budget of {budget} is loose for {numbers.get(name, 0)} {unit(name)}; "
        f"lower it in {BUDGET_FILE.name} to at most {max(tight[name], aims.get(name, 0))}"
        for name, budget in maxima.items()
        if budget > max(tight[name], aims.get(name, 0))
    ]


def unit(name):
    return "tracked files" if name == "files" else "code lines"


def fail_with(lines):
    if lines:
        pytest.fail("\n".join(lines), pytrace=False)


def test_every_area_stays_within_its_budget():
    fail_with(excesses(current_sizes(), BUDGETS))


def test_every_budget_is_tight():
    fail_with(loose_budgets(current_sizes(), BUDGETS))


PYTHON = '''"""Docstring of
a module."""

import os  # comment


def name(x: int) -> str:
    """Docstring."""
    # comment
    return f"""
    {x}

    """


WIDTH = 1
"""Docstring of an attribute."""
'''
C = """/* comment
 * of two lines */
#include <math.h>
static const char *link = "http://x"; // comment
// comment

int area(int a) /* it's */
{
    return a; /* comment */
}
"""


def test_blank_lines_comments_and_docstrings_do_not_count():
    assert code_lines.python_size(PYTHON) == (6, 4)
    assert code_lines.c_size(C) == (6, 2)


def write_tree(root):
    files = {
        ".gitignore": "__pycache__/\n/out/\n",
        "setup.py": "a = 1\n",
        "models/__init__.py": "a = 1\nb = 2\n",
        "models/core.c": "int a;\n",
        "models/page.html": "<p>\n",
        "packages/lab/pyproject.toml": "",
        "packages/lab/src/lab/x.py": "a = 1\n",
        "packages/lab/tests/test_x.py": "a = 1\nb = 1\nc = 1\n",
        "packages/lab/studies/x.py": "a = 1\n",
        "tests/test_a.py": "a = 1\n",
    }
    ignored = {"models/__pycache__/x.py": "a = 1\n", "out/x.py": "a = 1\n"}
    for name, text in (files | ignored).items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (root / "src").mkdir()
    (root / "src" / "models").symlink_to("../models")
    return {*files, "src/models"}


def test_areas_and_sums_of_a_small_tree(tmp_path):
    write_tree(tmp_path)
    assert {name: (size.lines, size.files) for name, size in code_lines.sizes(tmp_path).items()} == {
        "models": (3, 3),
        "packages/lab": (1, 2),
        "packages/lab/studies": (1, 1),
        "packages/lab/tests": (3, 1),
        "rest": (1, 2),
        "src": (0, 1),
        "tests": (1, 1),
        "root wheel": (3, 4),
        "all packages": (1, 2),
        "all studies": (1, 1),
        "all tests": (4, 2),
        "all files": (10, 11),
    }


def test_tree_without_git_has_the_files_that_git_would_track(tmp_path):
    files = write_tree(tmp_path)
    assert code_lines.tracked_files(tmp_path) == sorted(files)
    for words in (["init", "--quiet"], ["add", "."]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    assert code_lines.tracked_files(tmp_path) == sorted(files)
    (tmp_path / "new.py").write_text("a = 1\n", encoding="utf-8")
    assert code_lines.tracked_files(tmp_path) == sorted(files)
