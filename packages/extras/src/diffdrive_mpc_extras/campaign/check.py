"""Find a mistake in a campaign before the first run is driven."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.drive import built


def check_definitions(definitions: Sequence[Definition]) -> None:
    """Build a run for each name that occurs, and for the least and the largest value of each number.

    Combinations of them are not all built: a run that cannot be has its error in its row.

    Raises ConfigError, which names the factor that was looked at, if one cannot be built.
    """
    for index, factor in sorted(_telling(definitions).items()):
        try:
            with built(definitions[index]):
                pass
        except ValueError as error:
            raise ConfigError(f"a run with {factor}: {error}") from error


def _telling(definitions: Sequence[Definition]) -> dict[int, str]:
    """Runs to build, each with the factor for which."""
    named: dict[tuple[str, object], int] = {}
    least: dict[str, tuple[float, int]] = {}
    largest: dict[str, tuple[float, int]] = {}
    for index, definition in enumerate(definitions):
        for name, value in definition.factors.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool) and name != "seed":
                least[name] = min(least.get(name, (value, index)), (value, index))
                largest[name] = max(largest.get(name, (value, index)), (value, index))
            elif name != "seed":
                named.setdefault((name, value), index)
    named_values = {index: f"{name} = {value}" for (name, value), index in named.items()}
    ends = [(name, end) for ends in (least, largest) for name, end in ends.items()]
    return named_values | {index: f"{name} = {value:g}" for name, (value, index) in ends}
