"""Size budgets of the repository: code lines per area and tracked files."""

from pathlib import Path

import pytest
import yaml

import code_lines

BUDGET_FILE = Path(__file__).with_name("size_budget.yaml")
BUDGETS = yaml.safe_load(BUDGET_FILE.read_text(encoding="utf-8"))


def test_every_area_is_within_a_tight_budget():
    if not code_lines.tracked_files():
        pytest.skip("needs git and a clone")
    sizes, lines = code_lines.sizes(), []
    numbers = {name: size.lines for name, size in sizes.items()} | {"files": sizes["all files"].files}
    del numbers["all files"]
    maxima = BUDGETS["lines"] | {"files": BUDGETS["files"]}
    for name in numbers | maxima:
        number, budget = numbers.get(name, 0), maxima.get(name, 0)
        unit, margin = ("tracked files", 10) if name == "files" else ("code lines", 100)
        loosest = max(int(1.02 * number) + margin, BUDGETS["aims"].get(name, 0))
        if number > budget:
            lines.append(
                f"{name}: {number} {unit} exceed the budget of {budget} by {number - budget}; remove code, "
                f"or raise the budget in {BUDGET_FILE.name} in a separate commit that states the reason"
            )
        elif budget > loosest:
            lines.append(
                f"{name}: the budget of {budget} is loose for {number} {unit}; "
                f"lower it in {BUDGET_FILE.name} to at most {loosest}"
            )
    if lines:
        pytest.fail("\n".join(lines), pytrace=False)
