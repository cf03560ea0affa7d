"""Arguments that commands pass on to ROS."""

from __future__ import annotations

import typer

PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of a command that passes what follows `--ros-args` on to ROS."""


def ros_arguments(context: typer.Context) -> list[str]:
    """What follows `--ros-args`, with it; raises ValueError for words before it that no option takes."""
    words = list(context.args)
    ours = words[: words.index("--ros-args")] if "--ros-args" in words else words
    if ours:
        raise ValueError(f"unknown argument '{ours[0]}'; see --help; arguments for ROS follow --ros-args")
    return words
