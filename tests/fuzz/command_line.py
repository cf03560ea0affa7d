"""Fuzzer of the command line: commands end with 0, or with one line and 1 or 2, never with a traceback."""

from __future__ import annotations

import contextlib
import tempfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

from diffdrive_mpc.models.plug_ins import plug_in_names
from fuzz import odd
from fuzz.case import Case, FaultError, HangError

# These run for minutes or until interrupted, or belong to packages: only their options are parsed, with an unknown one.
_LONG = {"bench", "doctor", "node", "sim-robot", *plug_in_names("commands")}
_CODES = {0, 1, 2}
_FOR = 8.0
FILES = ("own.csv", "mapped.csv", "mapping.yaml", "own.mcap", "bag", "short.yaml")


class CommandLineFuzzer:
    """Known commands and options with odd values, and unknown options."""

    name, longest, count = "cli", 2 * _FOR, 100

    def draw(self, random: Random) -> Case:
        """Draw the words after the name of the program."""
        path, options = random.choice(commands())
        words = list(path)
        for _ in range(random.choice((0, 1, 1, 2, 3))):
            if options and random.random() < 0.85:
                option, takes_value = random.choice(options)
                words += [option, _value(random)] if takes_value else [option]
            else:
                words.append(_value(random))
        if _is_long(path):
            words.insert(random.randrange(len(path), len(words) + 1), "--no-such-option")
        if random.random() < 0.1:
            words[random.randrange(len(words))] = _value(random)
        return {"words": [word.replace("\x00", "") for word in words], "long": _is_long(path)}

    def check(self, case: Case) -> None:
        """Invoke the command in a new folder."""
        from click.testing import CliRunner

        words = case["words"]
        if set(words) & _LONG and "--no-such-option" not in words:
            return
        originals = _files()
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            for name in FILES:
                Path(name).symlink_to(originals / name)
            try:
                done = CliRunner().invoke(_command(), words, prog_name="diffdrive-mpc")
            except HangError:
                # It works: what was typed makes sense.
                return
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            if isinstance(done.exception, HangError):
                return
            raise done.exception
        if done.exit_code not in _CODES:
            raise FaultError(f"exit: {done.exit_code}: {done.output[-300:]!r}")
        if done.exit_code == 2:
            lines = [line for line in done.output.splitlines() if line.startswith("error: ")]
            asked_for_help = "Usage:" in done.output
            if len(lines) != 1 and not asked_for_help:
                raise FaultError(f"error lines: {len(lines)}: {done.output[-300:]!r}")
            if lines and (len(lines[0]) > 1100 or not lines[0].isprintable()):
                raise FaultError(f"error line: cannot be shown: {lines[0][:300]!r}")


def _is_long(path: tuple[str, ...]) -> bool:
    return path[0] in _LONG


@cache
def _command() -> Any:
    from typer.main import get_command

    from diffdrive_mpc.app.cli import app

    return get_command(app)


@cache
def commands() -> list[tuple[tuple[str, ...], list[tuple[str, bool]]]]:
    """Return every command by its words, with its options and whether they take a value."""
    listed = []

    def walk(command: Any, words: tuple[str, ...]) -> None:
        options = []
        for parameter in command.params:
            takes = not getattr(parameter, "is_flag", False)
            options += [(name, takes) for name in (*parameter.opts, *parameter.secondary_opts) if name.startswith("-")]
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*words, name))
        if words:
            listed.append((words, options))

    walk(_command(), ())
    return listed


@cache
def _files() -> Path:
    from fuzz.logs import base_files

    return base_files()


def _value(random: Random) -> str:
    way = random.randrange(5)
    if way == 0:
        return random.choice(odd.WORDS)
    if way == 1:
        return repr(random.choice((odd.number(random), random.choice(odd.INTEGERS))))
    if way == 2:
        return random.choice(FILES)
    if way == 3:
        return random.choice(("ssm", "sm", "circle", "s", "mujoco", "model:ssm", "default", "none", "ideal", "push"))
    return random.choice(
        (
            "horizon=5",
            "weights.across=1e9",
            "limits.v=0",
            "x=1",
            "horizon=",
            "=",
            "a=b=c",
            "horizon=[1,2]",
            "out",
            "1,2,3",
        )
    )
