"""Import of a package's public names on first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any


def on_first_use(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` for `package` that imports each name from its module in `homes` on first use.

    The use of one module then does not load the others.
    """

    def look_up(name: str) -> Any:  # noqa: ANN401 - type checkers use the imports under TYPE_CHECKING
        if name not in homes:
            near = get_close_matches(name, homes, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise AttributeError(f"module '{package}' has no attribute '{name}'{hint}")
        return getattr(import_module(f".{homes[name]}", package), name)

    return look_up
