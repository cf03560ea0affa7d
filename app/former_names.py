"""Former names of commands and options: a user who types one reads what does its job now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from diffdrive_mpc.models.plug_ins import check_package


@cache
def former_names(kind: str) -> Mapping[str, str]:
    """Return the lines for former names by the words that were typed; `kind` is `commands` or `options`."""
    import yaml  # noqa: PLC0415 - --help does without it

    data = yaml.safe_load(Path(__file__).with_name("former_names.yaml").read_text(encoding="utf-8"))
    return data[kind] or {}


def check_options(words: Sequence[str]) -> None:
    """Raise ValueError if a typed option of a command has another name now or was removed."""
    for word in words[1:]:
        option = f"{words[0]} {word.partition('=')[0]}"
        if option in former_names("options"):
            raise ValueError(f"{option}: {former_names('options')[option]}")


class WithFormerNames(TyperGroup):
    """A group of commands that knows former names and the commands of packages that are not installed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 - of a class that typer hides
        """Parse the words of the command line; raises ValueError if one is a former option."""
        if ctx.parent is None and args and not ctx.resilient_parsing:
            check_options(args)
        return super().parse_args(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - of classes that typer hides
        """Return the command of that name; None if it is unknown.

        Raises ValueError for a former name, and MissingPackageError if its package is not installed.
        """
        words = cmd_name if ctx.parent is None else f"{ctx.info_name} {cmd_name}"
        command = super().get_command(ctx, cmd_name)
        if command is not None or ctx.resilient_parsing:
            return command
        if words in former_names("commands"):
            raise ValueError(f"{words}: {former_names('commands')[words]}")
        check_package("commands", words.replace(" ", "."))
        return None
