"""Groups of commands that name the package of a command that is not installed."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from diffdrive_mpc.models.plug_ins import check_package


class PackagedGroup(TyperGroup):
    """Group of commands to which packages can add commands."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - classes that typer does not export
        """Return the command of a name, or None if unknown; raise MissingPackageError if an absent package has it."""
        command = super().get_command(ctx, cmd_name)
        if command is None and not ctx.resilient_parsing:
            check_package("commands", cmd_name if ctx.parent is None else f"{ctx.info_name}.{cmd_name}")
        return command
