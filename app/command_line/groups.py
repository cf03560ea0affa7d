"""Groups of commands, with full help texts and with messages about the package of a missing command."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from diffdrive_mpc.models.plug_ins import check_package


class FullHelp(TyperGroup):
    """Group of commands whose help shows the complete first sentence of each command."""

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
