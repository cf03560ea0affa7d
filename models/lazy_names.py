"""Public names of a package that are imported when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import import_module
from typing import Any


def on_first_use(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a `__getattr__` for `package` that imports the names of `homes` from their modules on first use.

    A user of one module then does not load the others.
    """

    def look_up(name: str) -> Any:  # noqa: ANN401 - the type checker sees imports of its own
        if name not in homes:
            near = get_close_matches(name, homes, 1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise AttributeError(f"module '{package}' has no attribute '{name}'{hint}")
        return getattr(import_module(f"{package}.{homes[name]}"), name)

    return look_up
