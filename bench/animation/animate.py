"""A drive as a film, drawn picture by picture with a progress bar."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from diffdrive_mpc.bench.animation.film import Film
from diffdrive_mpc.bench.animation.film_file import STILL, WRITERS, film_path
from diffdrive_mpc.bench.animation.playback import Playback
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.whole_file import whole_file
from diffdrive_mpc.sim.view.body import Body
from diffdrive_mpc.sim.view.offscreen import Picture


@contextmanager
def film_draft(path: Path, option: str) -> Iterator[Path]:
    """A place to write a film to, which then becomes `path`; raises ConfigError at once if that cannot be."""
    with ExitStack() as stack:
        try:
            draft = stack.enter_context(whole_file(film_path(path)))
        except ConfigError as error:
            raise ConfigError(f"{option} {error}") from error
        yield draft


def animate(playback: Playback, film: Film, body: Body | None, draft: Path) -> None:
    """Write the film of `playback` to `draft`, whose ending says how; arguments and errors are those of `pictures`."""
    from diffdrive_mpc.bench.animation.pictures import pictures  # noqa: PLC0415 - matplotlib loads slowly

    ending = draft.suffix.lower()
    film = replace(film, still=ending == STILL)
    with ProgressBar("drawing") as bar:
        WRITERS[ending](draft, _counted(pictures(playback, film, body), len(film.times(playback)), bar), film.fps)


def _counted(drawn: Iterator[Picture], total: int, bar: ProgressBar) -> Iterator[Picture]:
    for count, picture in enumerate(drawn, start=1):
        yield picture
        bar.at(count, total)
