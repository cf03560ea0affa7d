"""Guarantee for unusable input: the project raises an error with a message of one line."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from diffdrive_mpc.models.errors import DiffdriveMpcError
from fuzz.case import FaultError

T = TypeVar("T")
_MAX_LENGTH = 4000
_TESTS = str(Path(__file__).parents[1])


def refused_or(function: Callable[[], T]) -> T | None:
    """Return the result of `function`; None if it raises an expected error. Other errors are propagated."""
    try:
        return function()
    except (DiffdriveMpcError, ValueError, OSError) as error:
        check_refusal(error)
        return None


def check_refusal(error: Exception) -> None:
    """Raise FaultError if the message is not a short line, or the error itself if a library raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    innermost = frames[-1].filename
    is_own = "diffdrive_mpc" in innermost or (
        innermost.startswith("/")
        and any(f"/{room}/" in innermost for room in ("models", "mpc", "sim", "bench", "app", "studies"))
        and "site-packages" not in innermost
        and not innermost.startswith(_TESTS)
    )
    if not isinstance(error, OSError) and not is_own and not isinstance(error, DiffdriveMpcError):
        raise error
    text = str(error)
    if not text.strip() or "\n" in text:
        raise FaultError(f"message: not one line: {text[:300]!r}")
    if len(text) > _MAX_LENGTH:
        raise FaultError(f"long message: {len(text)} characters: {text[:200]!r}")
