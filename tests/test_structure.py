"""Who may import whom."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SITE = ROOT / "studies" / "site"
ALLOWED = {
    "models": {"models"},
    "mpc": {"mpc", "models"},
    "sim": {"sim", "models"},
    "bench": {"bench", "mpc", "sim", "models"},
    "app": {"app", "bench", "mpc", "sim", "models"},
    # Pages and tables of the commands that extras add come from bench.
    "extras": {"extras", "bench", "mpc", "sim", "models"},
    "studies": {"studies", "extras", "bench", "mpc", "sim", "models"},
}


def imported(path):
    """First names of what a file imports; of our own modules the room."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (first(alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "diffdrive_mpc":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield first(node.module)


def first(name):
    return name.removeprefix("diffdrive_mpc.").partition(".")[0]


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for path in (ROOT / package).rglob("*.py"):
        ours = {name for name in imported(path) if name in ALLOWED}
        # The site of the documents shows the command line.
        assert ours - ({"app"} if SITE in path.parents else set()) <= ALLOWED[package], path
        if package != "sim":
            assert "mujoco" not in set(imported(path)), path


@pytest.mark.parametrize("package", ALLOWED)
def test_ros_is_imported_where_the_nodes_are_and_nowhere_else(package):
    for path in (ROOT / package).rglob("*.py"):
        nodes = (ROOT / "mpc" / "ros", ROOT / "mpc" / "monitor" / "ros", ROOT / "sim" / "ros")
        if path.parent not in nodes:
            assert not {name for name in imported(path) if name == "rclpy" or name.endswith("_msgs")}, path


@pytest.mark.parametrize("package", sorted(ALLOWED.keys() - {"studies"}))
def test_types_and_parameters_ship(package):
    assert (ROOT / package / "py.typed").exists()
