"""Former names of commands, each answered with the present one."""

from __future__ import annotations

from typing import Any

from typer.core import TyperGroup

_STUDIES = (
    "tracking",
    "robustness",
    "worlds",
    "peers",
    "reproduce",
    "saving",
    "energy-front",
    "speed",
    "loop-speed",
    "real-logs",
    "models fit",
    "models drives",
    "models train",
    "models calibrate",
    "models truths",
)
_CLONE = "in a clone of the repository"
MOVED = {
    "robot": "`diffdrive-mpc sim-robot`",
    "study": f"`python -m studies`, {_CLONE}",
    "monitor-study": f"`python -m studies monitor`, {_CLONE}",
    **{name: f"`python -m studies {name}`, {_CLONE}" for name in _STUDIES},
}
"""By the words that were typed, docs/moved.md."""


class WithFormerNames(TyperGroup):
    """A group of commands that knows their former names."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401 - of classes that typer hides
        """The command of that name; None if there is none. Raises ValueError for a former name."""
        words = cmd_name if ctx.parent is None else f"{ctx.info_name} {cmd_name}"
        if words in MOVED and not ctx.resilient_parsing:
            raise ValueError(f"{words}: this command is {MOVED[words]} now")
        return super().get_command(ctx, cmd_name)
