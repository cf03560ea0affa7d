"""Size budgets of the repository: code lines per area and tracked files."""

from pathlib import Path

import pytest
import yaml

import code_lines

BUDGET_FILE = Path(__file__).with_name("size_budget.yaml")
BUDGETS = yaml.safe_load(BUDGET_FILE.read_text(encoding="utf-8"))


def current_sizes():
    """Count the sizes of this tree, which takes seconds."""
    if not code_lines.tracked_files():
        pytest.skip("needs git and a clone")
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


def test_every_area_is_within_a_tight_budget():
    sizes = current_sizes()
    lines = excesses(sizes, BUDGETS) + loose_budgets(sizes, BUDGETS)
    if lines:
        pytest.fail("\n".join(lines), pytrace=False)
