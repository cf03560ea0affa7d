"""The modules of `sim` build on each other in one direction."""

from graphlib import TopologicalSorter
from pathlib import Path

from diffdrive_mpc import sim
from imports import imported

FOLDER = Path(sim.__file__).parent


def _imported(path: Path) -> set[str]:
    """Modules of `sim` that a file imports, inside functions and for type checking too."""
    names = {one for module, name in imported(path) for one in (module, f"{module}.{name}".rstrip("."))}
    return {name for name in names if name.startswith("diffdrive_mpc.sim.")}


def name(path: Path) -> str:
    return ".".join(("diffdrive_mpc.sim", *path.relative_to(FOLDER).with_suffix("").parts))


ALLOWED: dict[str, set[str]] = {
    "sensing": set(),
    "disturbances": set(),
    "metrics": set(),
    "core": set(),
    "plants": {"core", "sensing", "disturbances"},
    "ros": {"sensing", "plants"},
    "": {"sensing", "disturbances", "plants", "metrics"},
}
"""By room, the others that it may build on; "" stands for the files beside the rooms."""


def room(module: str) -> str:
    inside = module.split(".")[2:]
    return inside[0] if (FOLDER / inside[0]).is_dir() else ""


def modules() -> dict[str, set[str]]:
    return {name(path): _imported(path) for path in FOLDER.rglob("*.py") if path.stem != "__init__"}


def test_no_module_needs_itself_in_a_circle() -> None:
    found = modules()
    assert {"diffdrive_mpc.sim.metrics.metrics", "diffdrive_mpc.sim.metrics.tracking_errors"} <= found[
        "diffdrive_mpc.sim.run"
    ]
    TopologicalSorter(found).prepare()  # raises CycleError


def test_rooms_build_on_each_other_in_one_direction() -> None:
    arrows = {(room(user), room(used)) for user, all_used in modules().items() for used in all_used}
    assert ("plants", "sensing") in arrows and ("", "plants") in arrows
    assert {arrow for arrow in arrows if arrow[0] != arrow[1] and arrow[1] not in ALLOWED[arrow[0]]} == set()
    assert {user for user, _ in arrows} <= set(ALLOWED)
    assert {path.name for path in FOLDER.iterdir() if (path / "__init__.py").exists()} == set(ALLOWED) - {""}
