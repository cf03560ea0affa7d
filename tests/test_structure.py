"""Who may import whom."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

from imports import imported

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


def first_names(path):
    """First names of what a file imports; of our own modules the room."""
    for module, name in imported(path):
        yield name if name and module == "diffdrive_mpc" else first(module)


def first(name):
    return name.removeprefix("diffdrive_mpc.").partition(".")[0]


@pytest.mark.parametrize("package", ALLOWED)
def test_imports_run_one_way(package):
    for path in (ROOT / package).rglob("*.py"):
        ours = {name for name in first_names(path) if name in ALLOWED}
        # The site of the documents shows the command line.
        assert ours - ({"app"} if SITE in path.parents else set()) <= ALLOWED[package], path
        if package != "sim":
            assert "mujoco" not in set(first_names(path)), path


def test_the_picture_of_the_house_is_what_is_imported():
    """docs/architecture.md: a line for each room; on the right what it imports, no more and no less."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    head, *lines = re.search(r"^ {4}room .*\n(?: {4}.*\n)+", page, re.MULTILINE)[0].splitlines()
    shown = {line.split()[0]: set(line[head.index("imports") :].split()) for line in lines}
    known = {
        package: {name for path in (ROOT / package).rglob("*.py") for name in first_names(path)}
        & ALLOWED.keys() - {package}
        for package in ALLOWED
    }
    assert shown == known


@pytest.mark.parametrize("package", ALLOWED)
def test_ros_is_imported_where_the_nodes_are_and_nowhere_else(package):
    for path in (ROOT / package).rglob("*.py"):
        nodes = (ROOT / "mpc" / "ros", ROOT / "mpc" / "monitor" / "ros", ROOT / "sim" / "ros")
        if path.parent not in nodes:
            assert not {name for name in first_names(path) if name == "rclpy" or name.endswith("_msgs")}, path


def module_name(path):
    """Dotted, from the room; a package has its own name."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for room in ALLOWED for path in (ROOT / room).rglob("*.py")}


def of_types_alone(tree):
    """Nodes under `if TYPE_CHECKING`: they import nothing when the program runs."""
    guarded = (
        node for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    )
    return {id(inner) for node in guarded for inner in ast.walk(node)}


def imported_modules(path):
    """Our modules that a file imports, at its head or in a function."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    types = of_types_alone(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level and id(node) not in types:
            module = node.module.removeprefix("diffdrive_mpc.")
            for alias in node.names:
                inner = f"{module}.{alias.name}"
                if inner in MODULES or module in MODULES:
                    yield inner if inner in MODULES else module


IMPORTS = [(name, other) for name, path in MODULES.items() for other in imported_modules(path)]


@pytest.mark.parametrize("folder", sorted(name for name, path in MODULES.items() if path.name == "__init__.py"))
def test_folders_inside_a_folder_form_no_circle(folder):
    """Files beside each other may know each other; a folder and what imports it may not."""
    inside = f"{folder}."
    imports = {}
    for name, other in IMPORTS:
        if name.startswith(inside) and other.startswith(inside):
            ours, theirs = (one.removeprefix(inside).partition(".")[0] for one in (name, other))
            if ours != theirs:
                imports.setdefault(ours, set()).add(theirs)
    folders = [entry for entry in imports if (ROOT / inside.replace(".", "/") / entry).is_dir()]
    assert [entry for entry in folders if entry in reached_from(imports, entry)] == []


def test_the_controller_lies_in_the_layers_that_the_page_shows():
    """docs/architecture.md: a layer imports those below it, and nothing beside or above."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    lines = re.search(r"^ {4}nodes .*\n(?: {4}.*\n)+", page, re.MULTILINE)[0].splitlines()
    layers = [re.split(r" {2,}", line.strip())[1].split() for line in lines]
    height = {name: len(layers) - index for index, names in enumerate(layers) for name in names}
    inside = {name.split(".")[1] for name in MODULES if name.startswith("mpc.")} - {"monitor"}
    assert inside == set(height)
    for name, other in IMPORTS:
        if name.startswith("mpc.") and other.startswith("mpc."):
            ours, theirs = name.split(".")[1], other.split(".")[1]
            if ours != theirs and "monitor" not in (ours, theirs):
                assert height[ours] > height[theirs], f"{name} imports {other}"


def reached_from(imports, start):
    """What `start` imports, directly and through others."""
    reached, ahead = set(), [start]
    while ahead:
        new = imports.get(ahead.pop(), set()) - reached
        reached |= new
        ahead += new
    return reached


@pytest.mark.parametrize("package", sorted(ALLOWED.keys() - {"studies"}))
def test_types_and_parameters_ship(package):
    assert (ROOT / package / "py.typed").exists()


WORDS = {"found", "said", "told", "seen"}
"""What a name is, is said by the field's word for it: a response, a covariance, the lines of a file."""


@pytest.mark.parametrize("room", sorted(ALLOWED))
def test_a_variable_is_named_for_what_it_holds(room):
    """Fields of data keep their names: files and callers know them."""
    variables = {
        (name, node.arg if isinstance(node, ast.arg) else node.id, node.lineno)
        for name, path in MODULES.items()
        if first(name) == room
        for scope in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(scope, ast.FunctionDef)
        for node in ast.walk(scope)
        if isinstance(node, ast.arg) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    }
    assert len(variables) > 500
    assert {entry for entry in variables if entry[1] in WORDS} == set()


def test_a_public_class_has_a_name_of_its_own():
    """One name, one thing: over all rooms no two public classes share one."""
    places = defaultdict(list)
    for name, path in MODULES.items():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(name)
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_text_goes_to_the_terminal_by_two_doors_that_escape_it():
    """Names come from files, and files from anybody: only `echo` and the console of `bench/progress.py` print."""
    doors = {ROOT / "app/command_line/echo.py": "typer.echo(", ROOT / "bench/progress.py": "Console("}
    for package in ALLOWED.keys() - {"studies"}:
        for path in (ROOT / package).rglob("*.py"):
            printed = set(re.findall(r"\btyper\.s?echo\(|\b_?(?:Plain)?Console\(", path.read_text(encoding="utf-8")))
            assert not {call.removeprefix("_Plain") for call in printed} - {doors.get(path)}, path
