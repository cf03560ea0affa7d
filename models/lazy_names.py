"""Import of a package's public names on first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any


def on_first_use(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__`, which imports each name from its module in `homes` on first use, and `__dir__`.

    They are functions for the module `package`. The use of one name then does not load the modules of the others.
    """

    def look_up(name: str) -> Any:  # noqa: ANN401 - type checkers use the imports under TYPE_CHECKING
        if name not in homes:
            near = get_close_matches(name, homes, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise AttributeError(f"module '{package}' has no attribute '{name}'{hint}")
        return getattr(import_module(f".{homes[name]}", package), name)

    return look_up, lambda: sorted(homes)
