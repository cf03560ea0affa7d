"""Groups of commands that refer to the package of a command that is not installed."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

from diffdrive_mpc.models.plug_ins import check_package


class PackagedGroup(TyperGroup):
    """Group to which packages can add commands."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - classes that typer does not export
        """Return the command, or None; raise MissingPackageError if the command belongs to a missing package."""
        command = super().get_command(ctx, cmd_name)
        if command is None and not ctx.resilient_parsing:
            check_package("commands", cmd_name if ctx.parent is None else f"{ctx.info_name}.{cmd_name}")
        return command
