"""Code lines of each area of the repository: lines without blank lines, comments and docstrings.

`python tests/code_lines.py` prints the table that tests/test_size_budget.py compares with tests/size_budget.yaml.
"""

import ast
import io
import re
import subprocess
import tokenize
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
ROOMS = ("models", "mpc", "sim", "bench", "app", "src", "extras")
"""Folders of the root wheel; `extras` counts until packages replace it."""
PYTHON, C_LIKE = {".py"}, {".c", ".h", ".js", ".mjs", ".ts"}
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
# Literals come before comments, so that `//` in a literal starts no comment.
LITERAL_OR_COMMENT = re.compile(r"""("(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')|/\*.*?\*/|//[^\n]*""", re.DOTALL)


class Size(NamedTuple):
    """Size of a file or of an area."""

    lines: int = 0
    statements: int = 0
    files: int = 0


def python_size(text: str) -> tuple[int, int]:
    """Count code lines and statements of Python by tokens and syntax tree."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    code = {line for t in tokens if t.type not in NO_CODE for line in range(t.start[0], t.end[0] + 1)}
    statements = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt)]
    docstrings = [
        node
        for node in statements
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    docstring_lines = {line for node in docstrings for line in range(node.lineno, node.end_lineno + 1)}
    rows = text.splitlines()
    return sum(bool(rows[line - 1].strip()) for line in code - docstring_lines), len(statements) - len(docstrings)


def c_size(text: str) -> tuple[int, int]:
    """Count code lines and semicolons of C or JavaScript."""
    text = LITERAL_OR_COMMENT.sub(lambda match: match[1] or "\n" * match[0].count("\n"), text)
    return sum(bool(line.strip()) for line in text.splitlines()), text.count(";")


def file_size(path: Path) -> Size:
    """Return the size of a file; files in other languages and links have no code lines."""
    if path.is_symlink() or path.suffix not in PYTHON | C_LIKE:
        return Size(files=1)
    count = python_size if path.suffix in PYTHON else c_size
    return Size(*count(path.read_text(encoding="utf-8")), files=1)


def tracked_files(root: Path = ROOT) -> list[str]:
    """List the paths of files that git tracks; the list is empty without git or outside a repository."""
    command = ["git", "ls-files", "-z", "--cached"]
    try:
        result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return []
    names = sorted({*result.stdout.split("\0")} - {""})
    return [name for name in names if (root / name).is_symlink() or (root / name).exists()]


def area_of(name: str) -> str:
    """Return the area of a path: a folder of the root wheel, a package or its tests or studies, or another area."""
    first, *inner = name.split("/")
    if first == "packages" and len(inner) > 1:
        return "/".join([first, inner[0], *{"tests", "studies"}.intersection(inner[1:2])])
    return first if inner and first in {*ROOMS, "studies", "tests"} else "rest"


def total(parts: Iterable[Size]) -> Size:
    """Add sizes."""
    return Size(*map(sum, zip(*parts, strict=True)))


def sizes(root: Path = ROOT) -> dict[str, Size]:
    """Return the size of each area and of the sums, by name."""
    areas: defaultdict[str, list[Size]] = defaultdict(list)
    for name in tracked_files(root):
        areas[area_of(name)].append(file_size(root / name))
    by_area = {name: total(parts) for name, parts in sorted(areas.items())}
    members = {
        "root wheel": [name for name in by_area if name in ROOMS],
        "all packages": [name for name in by_area if name.startswith("packages/") and name.count("/") == 1],
        "all studies": [name for name in by_area if name.endswith("studies")],
        "all tests": [name for name in by_area if name.endswith("tests")],
        "all files": [*by_area],
    }
    return by_area | {name: total([by_area[area] for area in names] or [Size()]) for name, names in members.items()}


def table(root: Path = ROOT) -> str:
    """Format the sizes as a table with a line per area."""
    rows = [f"{size.lines:8} {size.statements:12} {size.files:6}  {name}" for name, size in sizes(root).items()]
    return "\n".join([f"{'lines':>8} {'statements':>12} {'files':>6}  area", *rows])


if __name__ == "__main__":
    print(table())
