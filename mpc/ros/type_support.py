"""Types of messages that only some installations have."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def message_type(package: str, name: str) -> type[Any] | None:
    """The type `package`.msg.`name`; None where it is not installed."""
    try:
        found: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        return None
    return found
