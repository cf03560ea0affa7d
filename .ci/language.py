"""Check docstring openings and identifiers against the rules of language in CONTRIBUTING.md.

Existing violations are counted per file and rule in .ci/language_exceptions.txt. The check fails if a count rises and
if a listed count is out of date; `--update` writes the counts again and refuses a higher total.
"""

import argparse
import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
EXCEPTIONS = ".ci/language_exceptions.txt"
NAMES = "one|other|own|kept|found|told|asked|said|seen|given|of|at|here|there|what|answer|begin"
OPENINGS = re.compile(
    r"(what|whatever|of|how|who|whose|whoever|which|why|where|whether|by how|as|to be|not)\b", re.IGNORECASE
)
VERBS = frozenset(re.findall("[A-Z][a-z]+", (ROOT / ".ci" / "verbs.txt").read_text(encoding="utf-8").split("\n", 1)[1]))
RULES = {
    "name": "must not be used as a name; use a noun of the field",
    "opening": "opens with a clause; start with a noun, or a function's docstring with an imperative verb",
    "verb": "does not start with an imperative verb; add a missing verb to .ci/verbs.txt",
}
C_TEXT = re.compile(r"""("(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')|/\*(.*?)\*/|//([^\n]*)""", re.DOTALL)
C_DECLARATION = re.compile(
    rf"\b(?!(?:return|goto|else|case|sizeof|define)\b)[A-Za-z_]\w*[\s*]+({NAMES})\s*(?=[=;,()\[:])"
)
C_LIST = re.compile(rf"^[ \t]*(?:\w+[ \t*]+)+\w+[^;(){{}}]*?,[ \t*]*({NAMES})\s*[=;,\[]", re.MULTILINE)


class Violation(NamedTuple):
    """Line of a file that violates a rule, and the offending text."""

    line: int
    rule: str
    text: str


def python_violations(source: str) -> Iterator[Violation]:
    """Yield violations of Python source: openings of docstrings, and bound names."""
    for node in ast.walk(ast.parse(source)):
        yield from (Violation(line, "name", name) for line, name in bound_names(node) if re.fullmatch(NAMES, name))
        if isinstance(node, ast.Module | ast.ClassDef):
            for target, after in zip(node.body, node.body[1:], strict=False):
                if isinstance(target, ast.Assign | ast.AnnAssign):
                    yield from docstring_violations(after, is_function=False)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and node.body:
            yield from docstring_violations(node.body[0], is_function=starts_with_verb(node))


def starts_with_verb(node: ast.AST) -> bool:
    """Return True for functions except tests, fixtures and properties."""
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not (
        node.name.startswith("test_")
        or any(re.search("property|fixture", ast.unparse(decorator)) for decorator in node.decorator_list)
    )


def docstring_violations(node: ast.stmt, is_function: bool) -> Iterator[Violation]:
    """Yield the violation of a statement if it is a docstring with a wrong opening."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        words = node.value.value.split(maxsplit=3)
        opening = " ".join(words[:3])
        if OPENINGS.match(opening):
            yield Violation(node.lineno, "opening", opening)
        elif is_function and words and (words[0].rstrip(",;:.") not in VERBS or words[1:2] == ["of"]):
            yield Violation(node.lineno, "verb", opening)


def bound_names(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of each variable, argument, field, function, class or import that a node binds."""
    match node:
        case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()) | ast.arg(arg=name):
            yield node.lineno, name
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            yield node.lineno, name
        case ast.ExceptHandler(name=str(name)) | ast.MatchAs(name=str(name)) | ast.alias(asname=str(name)):
            yield node.lineno, name


def c_violations(source: str) -> Iterator[Violation]:
    """Yield violations of C source: openings of comments, and names in declarations."""
    for match in C_TEXT.finditer(source):
        words = (match[2] or match[3] or "").lstrip("*!<").split(maxsplit=3)
        if OPENINGS.match(" ".join(words[:3])):
            yield Violation(source.count("\n", 0, match.start()) + 1, "opening", " ".join(words[:3]))
    code = C_TEXT.sub(lambda match: '""' if match[1] else "\n" * match[0].count("\n"), source)
    for match in sorted({m.start(1): m for p in (C_DECLARATION, C_LIST) for m in p.finditer(code)}.items()):
        yield Violation(code.count("\n", 0, match[0]) + 1, "name", match[1][1])


def violations(root: Path) -> dict[str, list[Violation]]:
    """Return the violations of each tracked Python and C file by path."""
    command = ["git", "ls-files", "-z", "*.py", "*.c", "*.h"]
    names = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.split("\0")
    files = [(name, root / name) for name in sorted({*names} - {""}) if (root / name).is_file()]
    checks = {".py": python_violations, ".c": c_violations, ".h": c_violations}
    return {
        name: sorted(checks[path.suffix](path.read_text(encoding="utf-8")))
        for name, path in files
        if not path.is_symlink()
    }


def listed_counts(path: Path) -> Counter[tuple[str, str]]:
    """Read the exceptions; each line has the path of a file and `rule=count` words."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    rows = [line.split() for line in lines if not line.startswith("#")]
    pairs = [(name, *pair.split("=")) for name, *pairs in rows for pair in pairs]
    return Counter({(name, rule): int(count) for name, rule, count in pairs})


def exceptions_text(counts: Counter[tuple[str, str]]) -> str:
    """Format exceptions in the format of `listed_counts`."""
    rows: dict[str, list[str]] = {}
    for (name, rule), count in sorted(counts.items()):
        rows.setdefault(name, []).append(f"{rule}={count}")
    head = "# Existing violations of .ci/language.py per file. Counts only fall: python .ci/language.py --update\n"
    return head + "".join(f"{name} {' '.join(pairs)}\n" for name, pairs in rows.items())


def totals(counts: Counter[tuple[str, str]]) -> Counter[str]:
    """Sum the counts of each rule."""
    return sum((Counter({rule: count}) for (_, rule), count in counts.items()), Counter())


def main(root: Path, words: list[str]) -> int:
    """Check or update; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--update", action="store_true", help="write the counts again")
    parser.add_argument("--allow-growth", action="store_true", help="let --update write higher totals")
    options = parser.parse_args(words)
    by_file = violations(root)
    counts = Counter((name, entry.rule) for name, entries in by_file.items() for entry in entries)
    listed = listed_counts(root / EXCEPTIONS)
    if options.update:
        growth = totals(counts) - totals(listed)
        if growth and not options.allow_growth:
            more = ", ".join(f"{count} more of rule {rule!r}" for rule, count in sorted(growth.items()))
            print(f"{EXCEPTIONS}: not updated: {more}; correct them, see python .ci/language.py", file=sys.stderr)
            return 1
        (root / EXCEPTIONS).write_text(exceptions_text(counts), encoding="utf-8")
        return 0
    for (name, rule), count in sorted((counts - listed).items()):
        for entry in by_file[name]:
            if entry.rule == rule:
                print(f"{name}:{entry.line}: {entry.text!r} {RULES[rule]}")
        print(f"{name}: {listed[name, rule]} violations of rule {rule!r} are listed; correct {count} of those above")
    for (name, rule), count in sorted((listed - counts).items()):
        print(f"{name}: {EXCEPTIONS} lists {count} more of rule {rule!r} than exist: python .ci/language.py --update")
    return int(counts != listed)


if __name__ == "__main__":
    sys.exit(main(ROOT, sys.argv[1:]))
