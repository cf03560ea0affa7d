"""The modules of `sim` build on each other in one direction."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

from diffdrive_mpc import sim

FOLDER = Path(sim.__file__).parent


def _imported(path: Path) -> set[str]:
    """Modules of `sim` that a file imports, inside functions and for type checking too."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name for name in found if name.startswith("diffdrive_mpc.sim.")}


def name(path: Path) -> str:
    return ".".join(("diffdrive_mpc.sim", *path.relative_to(FOLDER).with_suffix("").parts))


def test_no_module_needs_itself_in_a_circle() -> None:
    modules = {name(path): _imported(path) for path in FOLDER.rglob("*.py") if path.stem != "__init__"}
    assert {"diffdrive_mpc.sim.metrics.metrics", "diffdrive_mpc.sim.metrics.tracking_errors"} <= modules[
        "diffdrive_mpc.sim.run"
    ]
    TopologicalSorter(modules).prepare()  # raises CycleError
