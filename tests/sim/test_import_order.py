"""The modules of `sim` build on each other in one direction."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import sim

FOLDER = Path(sim.__file__).parent


def _imported(path: Path) -> set[str]:
    """Modules of `sim` that a file imports, inside functions and for type checking too."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.startswith("sim.")}


def test_no_module_needs_itself_in_a_circle() -> None:
    modules = {f"sim.{path.stem}": _imported(path) for path in FOLDER.glob("*.py") if path.stem != "__init__"}
    assert {"diffdrive_mpc.sim.metrics", "diffdrive_mpc.sim.tracking_errors"} <= modules["diffdrive_mpc.sim.run"]
    TopologicalSorter(modules).prepare()  # raises CycleError
