"""What a film is to be: which part of a drive, how fast, how large, and what is in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.sim.view.shots import Camera

SMALLEST, LARGEST = 160, 3840
"""Pixels of a side."""
MOST_PICTURES = 100_000
"""Nearly an hour, which takes hours to draw."""


@dataclass(frozen=True)
class Film:
    """How a drive is shown.

    Attributes
    ----------
    size
        Width and height [pixels], both even, as video formats want it.
    fps
        Pictures a second.
    speed
        Times as fast as it was.
    start, end
        What of the drive is shown [s]; None for from its beginning, to its end.
    render
        Whether MuJoCo's picture of the robot stands beside the view from above.
    alone
        MuJoCo's picture and nothing else.
    camera
        From where MuJoCo's picture is taken.
    surface
        Floor of that picture.
    still
        One picture, of the end.
    """

    size: tuple[int, int] = (1280, 720)
    fps: int = 30
    speed: float = 1.0
    start: float | None = None
    end: float | None = None
    render: bool = False
    alone: bool = False
    camera: Camera = Camera.CHASE
    surface: str = "default"
    still: bool = False

    def times(self, playback: Playback) -> FloatArray:
        """(m,) instants of the pictures [s]: the last is the last that fits; of a still picture the end alone.

        Raises ConfigError as `span` does, and for more than `MOST_PICTURES`.
        """
        start, end = self.span(playback)
        if self.still:
            return np.array([end])
        step = self.speed / self.fps
        if (end - start) / step > MOST_PICTURES:
            raise ConfigError(
                f"{(end - start) / step:,.0f} pictures, at most {MOST_PICTURES:,}; give a part by --from and --to, a "
                "higher --film-speed, or fewer --fps"
            )
        return np.asarray(start + step * np.arange(int((end - start) / step + 1e-6) + 1))

    def span(self, playback: Playback) -> tuple[float, float]:
        """From when to when the drive is shown [s].

        Raises
        ------
        models.checked_yaml.ConfigError
            If nothing of the drive lies between `start` and `end`.
        """
        first, last = float(playback.time[0]), float(playback.time[-1])
        start = first if self.start is None else max(first, self.start)
        end = last if self.end is None else min(last, self.end)
        if not start <= end:
            raise ConfigError(f"--from {self.start} --to {self.end}: the drive goes from {first:.1f} to {last:.1f} s")
        return start, end


def read_size(text: str) -> tuple[int, int]:
    """Width and height from `1280x720`; an odd number becomes the even one below. Raises ConfigError on other texts."""
    try:
        width, height = (int(number) // 2 * 2 for number in text.lower().split("x"))
    except ValueError as error:
        raise ConfigError(f"--size '{text}': give width and height in pixels, such as 1280x720") from error
    if not all(SMALLEST <= side <= LARGEST for side in (width, height)):
        raise ConfigError(f"--size '{text}': give sides from {SMALLEST} to {LARGEST} pixels")
    return width, height
