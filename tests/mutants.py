"""Mutation score of the core: change the product, and list the changes that no test detects.

A seed draws mutants from the files in `tests/mutants.yaml`: one sign, comparison, constant, index, field, negation or
extremum differs. Each is applied to a copy of the tree, in which the tests of its file run. A failed test, a crash or
a time-out kills the mutant. Mutants that compile to the same code are skipped.
"""

import argparse
import ast
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib import import_module
from itertools import accumulate, islice
from pathlib import Path
from types import CodeType

import cffi
import pytest
import yaml

from diffdrive_mpc.mpc.core.sources import core_texts

ROOT = Path(__file__).parents[1]
PLAN = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
# Required share of killed mutants; time limit as a multiple of that of the unchanged product, plus [s]; memory [bytes].
GOAL, TIME_FACTOR, EXTRA_TIME, MEMORY = 0.9, 4.0, 30.0, 8 << 30
PYTEST = ("-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", "not system and not long")
# A field of another type is not a valid mutant, but gcc 12 only warns.
ERRORS = ("-w", "-Werror=int-conversion", "-Werror=incompatible-pointer-types")
COMPILE = ("cc", "-std=c99", "-O2", "-fPIC", *ERRORS, "-I.")
# Imported once for all test runs.
PRELOADED = ("casadi", "cffi", "control", "hypothesis", "mujoco", "numpy", "osqp", "pydantic", "scipy.stats")

_STRING = r'[rf]*(?:"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\')|'
# Directives of C are skipped unless they define a number.
_SKIPPED = {
    ".c": r"/\*.*?\*/|//[^\n]*|^[ \t]*#(?!define \w+ [-\d.])(?:[^\n]*\\\n)*[^\n]*|" + _STRING,
    ".py": r'[rf]*""".*?"""|#[^\n]*|' + _STRING,
}
_TOKEN = (
    r"(?P<number>(?<![\w.])(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?!\w))|(?P<name>\w+)"
    r"|(?P<sign>->|\+\+|--|\*\*|//|[-+*/<>=!]=|&&|\|\||<<|>>|[-+*/<>=!.,()\[\]{}])"
)
_OPERATORS = "+ - += -= * / *= /= == != && || and or True False"
_FUNCTIONS = "min max fmin fmax minimum maximum argmin argmax any all sin cos"
_words = f"{_OPERATORS} {_FUNCTIONS}".split()
SWAPS = {word: (_words[i ^ 1],) for i, word in enumerate(_words)} | {
    **{"!": ("",), "not": ("",), "<": ("<=", ">"), "<=": ("<", ">"), ">": (">=", "<"), ">=": (">", "<")}
}
# Precedes the size of an array in its declaration: larger sizes have no effect, smaller sizes are undefined.
_ARRAY = re.compile(r"[ \t]*(?:static |const )*(?:real|int|ddmpc_\w+) (?:\w+ = [\w.()]+, )*[^=;(]*\[")
AXES = {"X": "Y", "Y": "X", "THETA": "X", "V": "OMEGA", "OMEGA": "V"}


@dataclass(frozen=True)
class Mutant:
    """A file with one token replaced: its relative path, its text, the span of the token, and the new word."""

    path: str
    original: str
    span: tuple[int, int]
    word: str

    @property
    def text(self) -> str:
        """Text of the changed file."""
        return self.original[: self.span[0]] + self.word + self.original[self.span[1] :]

    @property
    def is_size(self) -> bool:
        """True if the token is the size of an array in C."""
        return bool(_ARRAY.fullmatch(self.original, self.original.rfind("\n", 0, self.span[0]) + 1, self.span[0]))

    @property
    def change(self) -> tuple[str, str, str]:
        """File, and line before and after; these identify an explained mutant."""
        line = self.original.count("\n", 0, self.span[0])
        before, after = (text.splitlines()[line].strip() for text in (self.original, self.text))
        return self.path, before, after

    def __str__(self) -> str:
        _, before, after = self.change
        return f"{self.path}:{self.original.count(chr(10), 0, self.span[0]) + 1}\n    {before}\n    {after}"


def mutants_of(path: str, text: str) -> list[list[Mutant]]:
    """Return the mutants of a file, grouped by the changed token."""
    suffix = Path(path).suffix
    tokens = [t for t in re.finditer(_SKIPPED[suffix] + _TOKEN, text, re.DOTALL | re.MULTILINE) if t.lastgroup]
    hidden = _hidden_from(text) if suffix == ".py" else []
    fields: dict[str, set[str]] = {}
    for base, dot, name in zip(tokens, tokens[1:], tokens[2:], strict=False):
        if _is_field(text, base, dot, name):
            fields.setdefault(base[0], set()).add(name[0])
    sites = []
    for base, previous, token, following in zip(tokens, tokens[1:], tokens[2:], tokens[3:], strict=False):
        if any(start <= token.start() < end for start, end in hidden) or base[0] == "strict":
            continue
        options = _changes(previous, token, following)
        if _is_field(text, base, previous, token):
            options = sorted(fields[base[0]] - {token[0]})
        sites.append([Mutant(path, text, token.span(), option) for option in options])
    return [site for site in sites if site]


def _is_field(text: str, base: re.Match[str], dot: re.Match[str], name: re.Match[str]) -> bool:
    """Return True if a token is a field, not a function, of an object that is not a module."""
    is_called = text[name.end() : name.end() + 1] == "("
    return dot[0] in (".", "->") and base.lastgroup == "name" and base[0] not in ("np", "ca") and not is_called


def _changes(previous: re.Match[str], token: re.Match[str], following: re.Match[str]) -> list[str]:
    """Return the possible replacements of a token that is not a field."""
    word, is_index = token[0], previous[0] == "[" and following[0] == "]"
    if token.lastgroup == "number" and not word.isdigit():
        return [f"{1.1 * float(word) or 0.1:.12g}"]
    if token.lastgroup == "number":
        return [str(int(word) + 1), str(int(word) - 1)] if int(word) else ["1"]
    if is_index and (word in AXES or re.fullmatch("[a-z]", word)):
        return [AXES[word]] if word in AXES else [f"{word} + 1", f"{word} - 1"]
    is_pointer = word in "*/" and previous.lastgroup == "sign" and previous[0] not in ")]"
    return [] if is_pointer else list(SWAPS.get(word, ()))


def _hidden_from(text: str) -> list[tuple[int, int]]:
    """Return spans of a Python file without effect: imports, annotations and decorators."""
    starts = list(accumulate(map(len, text.splitlines(keepends=True)), initial=0))
    nodes = []
    for node in ast.walk(ast.parse(text)):
        parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        parts.append(node if isinstance(node, ast.Import | ast.ImportFrom) else None)
        nodes += [*filter(None, parts), *getattr(node, "decorator_list", ())]
    return [(starts[n.lineno - 1] + n.col_offset, starts[n.end_lineno - 1] + n.end_col_offset) for n in nodes]


class Tree:
    """Separate copy of the tree, in which one mutant at a time is applied."""

    def __init__(self, folder: Path) -> None:
        self._tree, self._sources = folder / "tree", folder / "sources"
        command = ("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard")
        for name in filter(None, subprocess.check_output(command, cwd=ROOT, text=True).split("\0")):
            if (ROOT / name).is_symlink() or (ROOT / name).is_file():
                (self._tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self._tree / name, follow_symlinks=False)
        self._times: dict[str, float] = {}
        self._codes: dict[str, object] = {}
        self._sources.mkdir()
        for name, text in core_texts().items():
            (self._sources / name).write_text(text, encoding="utf-8")
        self._objects = {path.stem: f"{path.stem}.o" for path in self._sources.glob("*.c")}
        subprocess.run([*COMPILE, "-c", *(f"{name}.c" for name in self._objects)], cwd=self._sources, check=True)
        for name in PRELOADED:
            import_module(name)
        os.environ["DIFFDRIVE_MPC_CACHE"] = str(folder / "cache")
        os.environ["PYTHONPATH"] = os.pathsep.join((str(self._tree / "src"), str(self._tree)))

    def changes_code(self, mutant: Mutant) -> bool:
        """Return True if a mutant compiles to code that differs from the original."""
        if mutant.is_size:
            return False
        compiled = _python_code if mutant.path.endswith(".py") else self._machine_code
        if mutant.path not in self._codes:
            self._codes[mutant.path] = compiled(mutant.original, mutant.path)
        return compiled(mutant.text, mutant.path) not in (None, self._codes[mutant.path])

    def _machine_code(self, text: str, path: str) -> bytes | None:
        command = [*COMPILE, f"-I{(self._tree / path).parent}", "-x", "c", "-c", "-", "-o", "mutant.o"]
        result = subprocess.run(command, input=text, text=True, cwd=self._sources, capture_output=True, check=False)
        return None if result.returncode else (self._sources / "mutant.o").read_bytes()

    def kills(self, mutant: Mutant) -> bool:
        """Return True if a test of the mutant's file fails, crashes or does not end."""
        stages = next(group["tests"] for group in PLAN["groups"] if mutant.path in group["files"])
        return any(self._fails(stage, mutant) for stage in stages)

    def _fails(self, stage: str, mutant: Mutant) -> bool:
        file = self._tree / mutant.path
        is_core = mutant.path.endswith(".c") and file.stem in self._objects
        if stage not in self._times:
            start = time.monotonic()
            # The unchanged core is compiled like its mutants, since other instructions round differently.
            if self._run(3600.0, stage, self._link(self._objects) if is_core else None):
                sys.exit(f"{self._log.read_text()}\nthe unchanged product fails: {stage}")
            self._times[stage] = time.monotonic() - start
        library = self._link(self._objects | {file.stem: "mutant.o"}) if is_core else None
        file_stat = file.stat()
        file.write_text(mutant.text, encoding="utf-8")
        # Python compares file times in whole seconds: compiled code of the original must not be reused.
        os.utime(file, (file_stat.st_atime, file_stat.st_mtime + 10.0))
        try:
            return self._run(TIME_FACTOR * self._times[stage] + EXTRA_TIME, stage, library, keep=False) != 0
        finally:
            file.write_text(mutant.original, encoding="utf-8")
            os.utime(file, (file_stat.st_atime, file_stat.st_mtime))

    def _link(self, objects: dict[str, str]) -> Path:
        """Link the core and return the library."""
        library = self._sources / "core.so"
        subprocess.run(["cc", "-shared", *objects.values(), "-o", library, "-lm"], cwd=self._sources, check=True)
        return library

    @property
    def _log(self) -> Path:
        return self._sources / "log"

    def _run(self, seconds: float, stage: str, library: Path | None = None, *, keep: bool = True) -> int:
        """Run tests in a copy of this process; end it and its children after `seconds`; return 0 if the tests pass."""
        child = os.fork()
        if child == 0:
            os.setsid()
            os.chdir(self._tree)
            log = os.open(self._log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            os.dup2(log, 1)
            os.dup2(log, 2)
            os._exit(_run_pytest(self._tree, stage, library, keep=keep))
        deadline, status = time.monotonic() + seconds, 0
        while (wait_result := os.waitpid(child, os.WNOHANG))[0] == 0:
            if time.monotonic() > deadline:
                break
            time.sleep(0.05)
        status = wait_result[1] if wait_result[0] else 1
        with suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        if wait_result[0] == 0:
            os.waitpid(child, 0)
        return status


def _run_pytest(tree: Path, stage: str, library: Path | None, *, keep: bool) -> int:
    """Run pytest and return its result; `keep` allows compiled Python files, and `library` replaces the core."""
    sys.dont_write_bytecode = not keep
    for name in [name for name in sys.modules if name.partition(".")[0] == "diffdrive_mpc"]:
        del sys.modules[name]
    # Folders of the clone, such as those of the packages, become folders of the tree, except a virtual environment.
    is_ours = [Path(path).is_relative_to(ROOT) and "site-packages" not in path for path in sys.path]
    paths = [
        str(tree / Path(path).relative_to(ROOT)) if ours else path for path, ours in zip(sys.path, is_ours, strict=True)
    ]
    sys.path[:] = [str(tree / "src"), str(tree), *paths]
    if library:
        core = import_module("diffdrive_mpc.mpc.core.library")

        def load_library(_: str, declarations: str, *rest: object) -> tuple[cffi.FFI, object]:
            ffi = cffi.FFI()
            ffi.cdef(declarations)
            return ffi, ffi.dlopen(str(library))

        core.load_library = load_library
    return int(pytest.main([*PYTEST, *stage.split()]))


def _python_code(text: str, path: str) -> object:
    def parts(code: CodeType) -> tuple[object, ...]:
        values = [parts(value) if isinstance(value, CodeType) else repr(value) for value in code.co_consts]
        return code.co_code, code.co_names, code.co_varnames, values

    try:
        return parts(compile(text, path, "exec"))
    except SyntaxError:
        return None


def draw(tree: Tree, seed: int, count: int, only: list[str]) -> Iterator[Mutant]:
    """Draw `count` mutants that change the code, each at a different token."""
    files = [name for group in PLAN["groups"] for name in group["files"] if any(fnmatch(name, p) for p in only)]
    sites = [site for name in files for site in mutants_of(name, (ROOT / name).read_text("utf-8"))]
    generator = random.Random(seed)
    generator.shuffle(sites)
    return islice(filter(tree.changes_code, map(generator.choice, sites)), count)


def main() -> None:
    """Draw, test and list mutants."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--only", nargs="+", default=["*"], help="files or patterns, such as mpc/core/*.c")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    explained = {(entry["file"], entry["before"], entry["after"]) for entry in PLAN["explained"]}
    fates: dict[str, list[Mutant]] = {"killed": [], "explained": [], "SURVIVES": []}
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        tree = Tree(Path(folder))
        for mutant in draw(tree, options.seed, options.count, options.only):
            fate = "explained" if mutant.change in explained else "killed" if tree.kills(mutant) else "SURVIVES"
            fates[fate].append(mutant)
            print(f"{fate:9} {mutant}", flush=True)
    killed, explained_count, survivors = map(len, fates.values())
    print(f"seed {options.seed}: {killed} killed, {explained_count} explained, {survivors} survive")
    print(*fates["SURVIVES"], sep="\n")
    sys.exit(killed < GOAL * (killed + survivors))


if __name__ == "__main__":
    main()
