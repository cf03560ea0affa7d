"""Groups of commands, with full help texts and with messages about the package of a missing command."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from diffdrive_mpc.models.plug_ins import check_package

_VALUES = {"str": "NAME", "int": "N", "int range": "N", "float": "NUMBER", "float range": "NUMBER", "path": "PATH"}
"""Placeholder of a value in a help text, by typer's name of its type."""


class _HelpFormatter(typer.Context.formatter_class):  # type: ignore[misc, valid-type]
    """Formatter with placeholders such as PATH and N, ranges in words, and examples that can be copied."""

    def write_usage(self, prog: str, args: str = "", prefix: str | None = None) -> None:
        """Write the usage line with `NAME` for a required argument and `[NAME]` for an optional one."""
        required = re.sub(r"\{(.+?)(?:\.\.\.)?\}", r"\1", args)
        super().write_usage(prog, re.sub(r"\b[a-z]+\b", lambda word: word[0].upper(), required), prefix)

    def write_dl(self, rows: Sequence[tuple[str, str]], *args: int) -> None:
        """Write the rows of options, arguments or commands."""
        super().write_dl([(_placeholder(name), _default(text)) for name, text in rows], *args)

    def write_text(self, text: str) -> None:
        """Write a paragraph, or an example whose lines end with a backslash."""
        if not text.startswith("Example: "):
            super().write_text(text)
            return
        lines = textwrap.wrap(text, self.width - 4, break_on_hyphens=False, break_long_words=False)
        self.write("  " + " \\\n    ".join(lines) + "\n")


def _placeholder(name: str) -> str:
    if name.startswith("-"):
        return re.sub(r"<(.+?)>", lambda kind: _VALUES.get(kind[1], kind[1]), name)
    argument, kind, _ = name.partition(" <")
    return argument.upper() if kind else name


def _default(text: str) -> str:
    text = re.sub(r"\[default: \((.*)\)(; [^()]*)?\]$", r"[default: \1\2]", text)
    return re.sub(r"([\d.]+)<=x<=([\d.]+)\]$", r"\1 to \2]", re.sub(r"x>=([\d.]+)\]$", r"at least \1]", text))


class _Context(typer.Context):
    """Context of a command with this module's formatter."""

    formatter_class = _HelpFormatter


class FullHelp(TyperGroup):
    """Group of commands whose help shows the complete first sentence of each command."""

    context_class = _Context

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - classes that typer does not export
        """Return the command, or None."""
        command: Any = super().get_command(ctx, cmd_name)
        if command is not None:
            command.context_class = _Context
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - classes that typer does not export
        """List the commands by panel."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command: Any = self.get_command(ctx, name)
            panel = command.rich_help_panel if isinstance(command.rich_help_panel, str) else "Commands"
            if not command.hidden:
                panels.setdefault(panel, []).append((name, command.get_short_help_str(limit=1000)))
        for panel, rows in panels.items():
            with formatter.section(panel):
                formatter.write_dl(rows)


class PackagedGroup(FullHelp):
    """Group to which packages can add commands."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - classes that typer does not export
        """Return the command, or None; raise MissingPackageError if the command belongs to a missing package."""
        command = super().get_command(ctx, cmd_name)
        if command is None and not ctx.resilient_parsing:
            check_package("commands", cmd_name if ctx.parent is None else f"{ctx.info_name}.{cmd_name}")
        return command
