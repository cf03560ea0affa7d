"""Draw every figure of an experiment into a folder."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Container
from functools import partial
from pathlib import Path

from diffdrive_mpc.bench.figures.case import draw_case
from diffdrive_mpc.bench.figures.horizon import draw_horizons
from diffdrive_mpc.bench.figures.overview import draw_overview
from diffdrive_mpc.bench.figures.step_time import draw_step_times
from diffdrive_mpc.bench.groups import groups
from diffdrive_mpc.bench.results import Results


def draw_all(results: Results, folder: Path, on_done: Callable[[], None]) -> list[str]:
    """Draw the figures of `results` into `folder`; `on_done` is called after each.

    Only runs of the first seed are drawn one by one.

    Returns
    -------
    list of str
        Names of the files, the overview first.
    """
    jobs: dict[str, Callable[[Path], None]] = {
        "overview.png": partial(draw_overview, results.main),
        "step-time.png": partial(draw_step_times, results.main),
    }
    if results.horizon:
        jobs["horizon.png"] = partial(draw_horizons, results.horizon)
    for name, group in groups(results.main).items():
        for outcome in group:
            if outcome.case.seed == results.experiment.seeds[0]:
                title = f"{name}, {outcome.case.labels['trajectory']}"
                jobs[free_name(title, jobs)] = partial(draw_case, outcome.run, f"{title}, seed {outcome.case.seed}")
    for file, draw in jobs.items():
        draw(folder / file)
        on_done()
    return list(jobs)


def count_figures(results: Results) -> int:
    """How many figures `draw_all` draws."""
    drawn = sum(outcome.case.seed == results.experiment.seeds[0] for outcome in results.main)
    return 2 + bool(results.horizon) + drawn


def free_name(text: str, taken: Container[str]) -> str:
    """File name of a figure called `text`, with a number where another one has that name already."""
    stem = file_name(text)
    names = itertools.chain([f"{stem}.png"], (f"{stem}-{number}.png" for number in itertools.count(2)))
    return next(name for name in names if name not in taken)


def file_name(text: str) -> str:
    """A name that every file system takes: lower case, words joined by hyphens."""
    return re.sub(r"[^a-z0-9.]+", "-", text.lower()).strip("-")
