"""Former commands, each with the command or document that does its job now."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

MOVED = {
    "commission": "follow docs/tutorials/commission.md",
    "log layouts": "open the log in Foxglove or PlotJuggler without a layout",
    "log rerun": "open the log in Foxglove, PlotJuggler or Rerun",
    "replay": "use `diffdrive-mpc log replay`",
    "schema": "use `diffdrive-mpc config schema KIND --json`",
}
"""Sentence by the words of the command."""


class WithFormerNames(TyperGroup):
    """A group of commands that knows its former commands."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - of classes that typer hides
        """Return the command of that name, or None; raise ValueError for a former command."""
        words = cmd_name if ctx.parent is None else f"{ctx.info_name} {cmd_name}"
        if words in MOVED and not ctx.resilient_parsing:
            raise ValueError(f"{words}: this command was removed; {MOVED[words]}")
        return super().get_command(ctx, cmd_name)
