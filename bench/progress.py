"""Terminal output: a progress bar that does not disturb time measurements, and a console for results."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.segment import Segment

from diffdrive_mpc.models.table import plain_text

if TYPE_CHECKING:
    from typing import Self

_REFRESH_PERIOD = 0.2
"""Minimum time between two drawings of the bar [s]."""
_LINE_PERIOD = 10.0
"""Time between two lines of progress if stderr is not a terminal, but for example a pipe or a build log [s]."""


class _PlainConsole(Console):
    """Console that removes control characters from texts, which may come from untrusted files."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the rendered segments; segments for colours and cursor movements are unchanged."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain_text(segment.text), segment.style)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401 - the signature of the base class
        """Print objects; `soft_wrap` applies to files and pipes only, and a terminal gets lines of its width."""
        super().print(*objects, **options | ({"soft_wrap": False} if self.is_terminal else {}))


class ProgressBar:
    """Progress bar on stderr, drawn in the caller's thread, because another thread would disturb measured step times.

    Parameters
    ----------
    text
        Description of the current stage.
    total
        Number of steps; None if it is not yet known.
    lines
        True to write a line of progress periodically if stderr is not a terminal.
    """

    def __init__(self, text: str, total: int | None = None, *, lines: bool = False) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        console = _PlainConsole(stderr=True)
        self._progress = Progress(
            *columns, console=console, auto_refresh=False, transient=True, disable=not console.is_terminal
        )
        self._task = self._progress.add_task(text, total=total)
        self._lines = lines and not console.is_terminal
        self._last_drawing, self._last_line = 0.0, time.monotonic()

    def __enter__(self) -> Self:
        """Show the bar."""
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove the bar."""
        self._progress.stop()

    def show(self, done: int, total: int) -> None:
        """Show that `done` of `total` steps are finished."""
        self._progress.update(self._task, completed=done, total=total)
        self._draw()

    def advance(self) -> None:
        """Advance by one step."""
        self._progress.advance(self._task)
        self._draw()

    def start_stage(self, text: str, total: int, done: int = 0) -> None:
        """Start another stage, of which `done` steps are already finished."""
        self._progress.update(self._task, description=text, completed=done, total=total)
        self._last_drawing = 0.0
        self._draw()

    def _draw(self) -> None:
        now = time.monotonic()
        if now - self._last_drawing >= _REFRESH_PERIOD:
            self._last_drawing = now
            self._progress.refresh()
        if self._lines and now - self._last_line >= _LINE_PERIOD:
            self._last_line, task = now, self._progress.tasks[0]
            total = "" if task.total is None else f" of {task.total:g}"
            sys.stderr.write(f"{plain_text(task.description)}: {task.completed:g}{total}\n")
            sys.stderr.flush()


def output_console(width_elsewhere: int = 140) -> Console:
    """Create a console on stdout with the width of the terminal or of the environment variable COLUMNS.

    For a file, a pipe or a build log, the width is `width_elsewhere`, which is enough for the tables.
    """
    console = _PlainConsole()
    if console.is_terminal or os.environ.get("COLUMNS", "").isdigit():
        return console
    return _PlainConsole(width=width_elsewhere)
