"""Random values in YAML files: `[low, high]` for a range, and `{one_of: [...]}` for a choice of values or ranges."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from diffdrive_mpc.models.checked_yaml import ConfigError

_ONE_OF = "one_of"


def draw_values(data: object, stream: np.random.Generator) -> Any:  # noqa: ANN401 - plain YAML data, checked by a schema
    """Replace each range and choice in `data` by a uniform random value of `stream`, in the order of the file."""
    return _replace(data, lambda ends: float(stream.uniform(ends[0], ends[1])), lambda size: int(stream.integers(size)))


def extremes(data: object) -> list[Any]:
    """Return copies of `data` without ranges and choices, which together contain all range ends and all choices.

    A schema with intervals as limits accepts all draws from `data` if it accepts all copies.
    """
    max_choices = max((len(node[_ONE_OF]) for _, node in _random_nodes(data) if isinstance(node, Mapping)), default=1)

    def copy(i: int) -> Any:  # noqa: ANN401 - plain YAML data
        return _replace(data, lambda ends: ends[i % 2], lambda size: i // 2 % size)

    return [copy(i) for i in range(2 * max_choices)]


def check_random_values(data: object, where: str) -> None:
    """Check the ranges and choices in `data`; `where` is the source of the data.

    Raises
    ------
    models.checked_yaml.ConfigError
        If the ends of a range are in the wrong order, or a choice has no values.
    """
    for key_path, node in _random_nodes(data):
        if isinstance(node, list) and not node[0] <= node[1]:
            raise ConfigError(f"{where}: {key_path}: give the lower end of a range first (found {node})")
        if isinstance(node, Mapping) and not (isinstance(node[_ONE_OF], list) and node[_ONE_OF]):
            raise ConfigError(
                f"{where}: {key_path}: one_of needs a list of at least one value (found {node[_ONE_OF]!r})"
            )


def _replace(data: object, from_range: Callable[[list[float]], float], from_choice: Callable[[int], int]) -> Any:  # noqa: ANN401
    if _is_range(data):
        return from_range(data)  # type: ignore[arg-type]
    if _is_choice(data):
        values = data[_ONE_OF]  # type: ignore[index]
        return _replace(values[from_choice(len(values))], from_range, from_choice)
    if isinstance(data, Mapping):
        return {key: _replace(value, from_range, from_choice) for key, value in data.items()}
    if isinstance(data, list):
        return [_replace(value, from_range, from_choice) for value in data]
    return data


def _random_nodes(data: object, key_path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield key path and node of every range and choice."""
    if _is_range(data) or _is_choice(data):
        yield key_path, data
    inner = data.items() if isinstance(data, Mapping) else enumerate(data) if isinstance(data, list) else ()
    for key, value in inner:
        # The list of a choice is not a range, but may contain ranges.
        if key == _ONE_OF and isinstance(value, list):
            for i, item in enumerate(value):
                yield from _random_nodes(item, f"{key_path}.{key}.{i}")
        else:
            yield from _random_nodes(value, f"{key_path}.{key}" if key_path else str(key))


def _is_range(data: object) -> bool:
    return (
        isinstance(data, list)
        and len(data) == 2
        and all(isinstance(end, (int, float)) and not isinstance(end, bool) for end in data)
    )


def _is_choice(data: object) -> bool:
    return isinstance(data, Mapping) and set(data) == {_ONE_OF}
