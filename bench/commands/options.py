"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="Controller configuration (YAML) in place of the shipped one.", show_default=False),
]
"""A controller configuration file."""


def split_names(text: str, option: str) -> tuple[str, ...]:
    """Split `a,b,c`; raises ValueError when a name is empty or given twice."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise ValueError(f"{option} '{text}': give one name, or several with commas between them")
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"{option} '{text}': '{twice[0]}' is given twice")
    return names


def split_numbers(text: str, option: str, *, least: int) -> tuple[int, ...]:
    """Split `1,2,3` into whole numbers of at least `least`; raises ValueError on anything else."""
    try:
        numbers = tuple(int(number) for number in split_names(text.rstrip(","), option))
    except ValueError as error:
        raise ValueError(f"{option} '{text}': give whole numbers with commas between them, each once") from error
    if min(numbers) < least:
        raise ValueError(f"{option} '{text}': each number must be at least {least}")
    return numbers


MOST_SEEDS = 10_000
"""More runs of one case than this take days, and their list alone could fill the memory."""


def parse_seeds(text: str) -> tuple[int, ...]:
    """`5` means the seeds 0 to 4, a list with commas (`7,` or `3,4`) those seeds; raises ValueError otherwise."""
    numbers = split_numbers(text, "--seeds", least=0)
    if "," in text:
        return numbers
    if numbers[0] == 0:
        raise ValueError("--seeds 0: give the number of seeds (at least 1), or a list such as 0,1,2")
    if numbers[0] > MOST_SEEDS:
        raise ValueError(
            f"--seeds {text}: give at most {MOST_SEEDS} seeds; for the one seed {text} write --seeds {text},"
        )
    return tuple(range(numbers[0]))
