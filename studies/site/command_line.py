"""Page of the site that describes all commands, generated from the commands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from diffdrive_mpc.app.cli import app

_HEAD = """# Which commands and options are there?

This page is generated from the commands, like the output of `diffdrive-mpc COMMAND --help`. Bad input is reported in
one line on stderr with exit code 2; see [what can go wrong](../safety.md#on-the-command-line).
"""
_EXAMPLE = re.compile(r"^Examples?:\s*", re.MULTILINE)


def command_line_page() -> str:
    """Describe every command with its arguments, options, defaults and example, as Markdown."""
    commands = list(_commands("diffdrive-mpc", typer.main.get_command(app)))
    rows = [f"| [`{_short_name(name)}`](#{_anchor(name)}) | {_first_line(command)} |" for name, command in commands]
    parts = [_HEAD, "\n".join(["| command | what it does |", "| --- | --- |", *rows])]
    return "\n\n".join([*parts, *(_section(name, command) for name, command in commands)]) + "\n"


def _commands(prefix: str, command: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - typer has no common type
    """Yield the full name and the object of each command, including the commands of groups."""
    for name, child in sorted(command.commands.items()):
        if hasattr(child, "commands"):
            yield from _commands(f"{prefix} {name}", child)
        else:
            yield f"{prefix} {name}", child


def _section(name: str, command: Any) -> str:  # noqa: ANN401
    arguments = [param for param in command.params if not param.opts[0].startswith("-")]
    options = [param for param in command.params if param.opts[0].startswith("-") and param.name != "help"]
    usage = " ".join([name, *map(_metavar, arguments), *(["[OPTIONS]"] if options else [])])
    parts = [f"## {_short_name(name)} {{ #{_anchor(name)} }}", f"```text\n{usage}\n```"]
    parts.append(_escape(command.help))
    rows = [f"| `{_metavar(argument)}` | | {_cell(argument.help)} |" for argument in arguments]
    rows += [f"| {_option_names(option)} | {_default(option)} | {_cell(option.help)} |" for option in options]
    if rows:
        parts.append("\n".join(["| argument or option | default | meaning |", "| --- | --- | --- |", *rows]))
    if command.epilog:
        example = _EXAMPLE.sub("", command.epilog).strip()
        parts.append(f"Example:\n\n```text\n{example}\n```")
    return "\n\n".join(filter(None, parts))


def _option_names(option: Any) -> str:  # noqa: ANN401
    names = ", ".join(f"`{name}`" for name in [*option.opts, *option.secondary_opts])
    return names if option.is_flag or not option.metavar else f"{names} `{option.metavar}`"


def _metavar(argument: Any) -> str:  # noqa: ANN401
    name = argument.metavar or argument.name.upper()
    return name if argument.required else f"[{name}]"


def _default(option: Any) -> str:  # noqa: ANN401
    if isinstance(option.show_default, str):
        return _cell(option.show_default)
    is_scalar = isinstance(option.default, str | int | float) and option.default is not False
    return f"`{option.default}`" if option.show_default and is_scalar else ""


def _cell(text: str | None) -> str:
    return " ".join(_escape(text).split()).replace("|", "\\|")


def _escape(text: str | None) -> str:
    """Escape a help text for Markdown, so that asterisks and underscores do not become emphasis."""
    return re.sub(r"([*_<>\[\]])", r"\\\1", text or "")


def _first_line(command: Any) -> str:  # noqa: ANN401
    return _cell((command.help or "").partition("\n\n")[0])


def _anchor(name: str) -> str:
    return _short_name(name).replace(" ", "-")


def _short_name(name: str) -> str:
    return name.removeprefix("diffdrive-mpc ")
