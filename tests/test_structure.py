"""Imports between folders of the root wheel, packages, folders and files."""

import ast
import re
import tomllib
from collections import defaultdict
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest

from imports import imports_of

ROOT = Path(__file__).parents[1]
ROOMS = ("models", "mpc", "sim", "bench", "app")
PACKAGES = ("diffdrive_mpc_extras", "diffdrive_mpc_monitor", "diffdrive_mpc_lab")
FOLDERS = {
    **{f"diffdrive_mpc.{room}": ROOT / room for room in ROOMS},
    **{name: next(ROOT.glob(f"packages/*/src/{name}")) for name in PACKAGES},
}
ROS_FOLDERS = {ROOT / "mpc/ros", ROOT / "sim/ros"} | {FOLDERS[name] / "ros" for name in PACKAGES}
MUJOCO_FOLDERS = {ROOT / "sim", FOLDERS["diffdrive_mpc_extras"] / "worlds"}
DEFERRED_CYCLES = {
    "diffdrive_mpc.models.velocity_model",
    "diffdrive_mpc.mpc.core.library",
    "diffdrive_mpc.mpc.trajectories.trajectory",
    "diffdrive_mpc_extras.worlds.world",
    "diffdrive_mpc.bench.peers",
    "diffdrive_mpc.bench.case",
}
"""One module of each import cycle that an import inside a function closes."""


def module_names(prefix, folder):
    for path in folder.rglob("*.py"):
        parts = path.relative_to(folder).with_suffix("").parts
        yield ".".join((prefix, *(parts[:-1] if parts[-1] == "__init__" else parts))), path


MODULES = {name: path for prefix, folder in FOLDERS.items() for name, path in module_names(prefix, folder)}


def statements(tree, inside_functions):
    """Yield the executed statements, without those under `if TYPE_CHECKING`."""
    remaining = list(tree.body)
    while remaining:
        node = remaining.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            remaining += node.orelse
            continue
        yield node
        if inside_functions or not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            remaining += [
                child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt | ast.excepthandler)
            ]


def imported_modules(path, inside_functions):
    for node in statements(ast.parse(path.read_text(encoding="utf-8")), inside_functions):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                yield next((n for n in (f"{node.module}.{alias.name}", node.module) if n in MODULES), None)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


@cache
def import_graph(inside_functions):
    return {
        name: {target for target in imported_modules(path, inside_functions) if target in MODULES} - {name}
        for name, path in MODULES.items()
    }


def reachable(graph, start):
    reached, remaining = set(), [start]
    while remaining:
        new = graph.get(remaining.pop(), set()) - reached
        reached |= new
        remaining += new
    return reached


def nodes_in_cycles(graph):
    return {name for name in graph if name in reachable(graph, name)}


def rooms_of(path):
    """Return the root folders and packages that a file imports."""
    names = (f"{module}.{name}".split(".") for module, name in imports_of(path))
    return {parts[1] if parts[0] == "diffdrive_mpc" else parts[0] for parts in names}


def test_rooms_and_packages_import_only_those_listed_in_contributing():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    head, *lines = re.search(r"^ {4}room .*\n(?: {4}.*\n)+", page, re.MULTILINE)[0].splitlines()
    documented = {line.split()[0]: set(line[head.index("imports") :].split()) for line in lines}
    short = {name: name.removeprefix("diffdrive_mpc_") for name in PACKAGES}
    actual = {
        short.get(name.removeprefix("diffdrive_mpc."), name.removeprefix("diffdrive_mpc.")): {
            short.get(target, target)
            for path in folder.rglob("*.py")
            for target in rooms_of(path) & {*ROOMS, *PACKAGES, "studies"} - {name.removeprefix("diffdrive_mpc.")}
        }
        for name, folder in FOLDERS.items()
    }
    assert documented == actual


@pytest.mark.parametrize("prefix", FOLDERS)
def test_ros_and_mujoco_are_imported_only_in_their_folders(prefix):
    for path in FOLDERS[prefix].rglob("*.py"):
        names = {module.partition(".")[0] for module, _ in imports_of(path)}
        if not ROS_FOLDERS & {*path.parents}:
            assert not {name for name in names if name == "rclpy" or name.endswith("_msgs")}, path
        if not MUJOCO_FOLDERS & {*path.parents}:
            assert "mujoco" not in names, path


@pytest.mark.parametrize("folder", sorted(name for name, path in MODULES.items() if path.name == "__init__.py"))
def test_folders_inside_a_folder_form_no_import_cycle(folder):
    inside, graph = f"{folder}.", defaultdict(set)
    for name, targets in import_graph(inside_functions=True).items():
        for target in targets:
            if name.startswith(inside) and target.startswith(inside):
                source, sink = (entry.removeprefix(inside).partition(".")[0] for entry in (name, target))
                if source != sink:
                    graph[source].add(sink)
    directory = MODULES[folder].parent
    assert {entry for entry in nodes_in_cycles(dict(graph)) if (directory / entry).is_dir()} == set()


def test_files_form_no_import_cycle():
    assert nodes_in_cycles(import_graph(inside_functions=False)) == set()


def test_imports_inside_functions_close_only_listed_cycles():
    reached = {name: reachable(import_graph(inside_functions=True), name) for name in MODULES}
    cycles = {frozenset(module for module in reached[name] if name in reached[module]) for name in MODULES}
    listed = [cycle & DEFERRED_CYCLES for cycle in cycles - {frozenset()}]
    assert sorted(map(sorted, listed)) == sorted([name] for name in DEFERRED_CYCLES)


def test_controller_folders_import_only_lower_layers_of_the_page():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    lines = re.search(r"^ {4}node .*\n(?: {4}.*\n)+", page, re.MULTILINE)[0].splitlines()
    layers = [re.split(r" {2,}", line.strip())[1].split() for line in lines]
    level = {name: len(layers) - index for index, names in enumerate(layers) for name in names}
    prefix = "diffdrive_mpc.mpc."
    assert {name.split(".")[2] for name in MODULES if name.startswith(prefix)} == set(level)
    for name, targets in import_graph(inside_functions=True).items():
        for target in targets:
            if name.startswith(prefix) and target.startswith(prefix):
                source, sink = name.split(".")[2], target.split(".")[2]
                assert source == sink or level[source] > level[sink], f"{name} imports {target}"


@pytest.mark.parametrize("package", sorted(path.name for path in (ROOT / "packages").iterdir()))
def test_wheel_contains_every_file_of_its_package(package):
    folder = ROOT / "packages" / package
    patterns = tomllib.loads((folder / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["*"]
    files = [path for path in (folder / "src").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    others = [path for path in files if path.suffix not in (".py", ".so") and not path.name.endswith(".schema.json")]
    others = [path for path in others if not any(part.endswith(".egg-info") for part in path.parts)]
    assert others
    assert [path for path in others if not any(fnmatch(path.name, pattern) for pattern in patterns)] == []


def test_only_echo_and_progress_console_print_because_they_escape_text():
    printers = {ROOT / "app/command_line/echo.py": "typer.echo(", ROOT / "bench/progress.py": "Console("}
    for path in MODULES.values():
        calls = set(re.findall(r"\btyper\.s?echo\(|\b_?(?:Plain)?Console\(", path.read_text(encoding="utf-8")))
        assert not {call.removeprefix("_Plain") for call in calls} - {printers.get(path)}, path
