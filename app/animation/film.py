"""What a film is to be: which part of a drive, how fast, how large, and what is in the picture."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from diffdrive_mpc.app.animation.playback import Playback
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.wheels import WheelKinematics
from diffdrive_mpc.sim.metrics.tracking_errors import metric_settings
from diffdrive_mpc.sim.view.body import BodyShape
from diffdrive_mpc.sim.view.offscreen import Picture
from diffdrive_mpc.sim.view.shots import Camera, Shots

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


# Pictures into a file: MP4 by ffmpeg, animated WebP or GIF by Pillow, or the last picture as PNG.


_GIF_COLOURS = 128
_COLOURS_OF_A_DRAWING = 4096
"""At most; a picture of MuJoCo has more."""
_ENCODING = (
    *("-an", "-c:v", "libx264", "-preset", "fast", "-crf", "21", "-pix_fmt", "yuv420p", "-movflags", "+faststart"),
    # The same pictures give the same file: one thread, no dates and no versions.
    *("-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1"),
)
"""yuv420p and the index in front: what browsers and phones play."""


def film_path(path: Path) -> Path:
    """The file to write: with an ending added where there is none, .mp4 where ffmpeg is there and .webp else.

    Raises
    ------
    models.checked_yaml.ConfigError
        If nothing here writes files with this ending, or what writes them is not installed.
    """
    if not path.suffix:
        path = path.with_name(f"{path.name}{'.mp4' if shutil.which('ffmpeg') else '.webp'}")
    ending = path.suffix.lower()
    if ending not in WRITERS:
        raise ConfigError(f"{path}: cannot write '{path.suffix}'; give a file that ends in {', '.join(WRITERS)}")
    if ending == ".mp4" and shutil.which("ffmpeg") is None:
        raise ConfigError(
            f"{path}: MP4 needs ffmpeg, which is not on the path: install it, or name a .webp or .gif file"
        )
    return path


def write_mp4(path: Path, pictures: Iterator[Picture], fps: int) -> None:
    """Write an MP4 file; raises ConfigError with what ffmpeg said if it fails."""
    first = next(pictures)
    height, width, _ = first.shape
    source = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-")
    command = ["ffmpeg", "-v", "error", "-y", *source, *_ENCODING, "-f", "mp4", str(path)]
    with tempfile.TemporaryFile() as messages:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages) as process:
            assert process.stdin is not None
            try:
                for picture in itertools.chain((first,), pictures):
                    process.stdin.write(picture.tobytes())
                process.stdin.close()
            except BrokenPipeError:
                pass  # it has ended; why stands in `said`
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            messages.seek(0)
            lines = messages.read().decode(errors="replace").split("\n")
            raise ConfigError(f"{path.name}: ffmpeg failed: {lines[0]}; name a .webp or .gif file")


def write_webp(path: Path, pictures: Iterator[Picture], fps: int) -> None:
    """Write an animated WebP file that repeats for ever: drawings without loss, which is smaller, too, renders with."""
    from PIL import Image  # noqa: PLC0415 - films only

    images = map(Image.fromarray, pictures)
    start = next(images)
    drawn = start.getcolors(_COLOURS_OF_A_DRAWING) is not None
    how = {"lossless": True, "quality": 40, "method": 2} if drawn else {"quality": 65, "method": 4}
    start.save(path, format="WEBP", save_all=True, append_images=images, duration=round(1000 / fps), loop=0, **how)


def write_gif(path: Path, pictures: Iterator[Picture], fps: int) -> None:
    """Write an animated GIF file that repeats for ever; all pictures have the colours of the first."""
    from PIL import Image  # noqa: PLC0415 - films only

    first = next(pictures)
    palette = Image.fromarray(first).quantize(_GIF_COLOURS, method=Image.Quantize.MEDIANCUT)
    frames = (
        Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE)
        for one in itertools.chain((first,), pictures)
    )
    start = next(frames)
    start.save(path, format="GIF", save_all=True, append_images=frames, duration=round(1000 / fps), loop=0)


def write_png(path: Path, pictures: Iterator[Picture], _fps: int) -> None:
    """Write the last picture."""
    from PIL import Image  # noqa: PLC0415 - films only

    *_, last = pictures
    Image.fromarray(last).save(path, format="PNG", optimize=True)


WRITERS: dict[str, Callable[[Path, Iterator[Picture], int], None]] = {
    ".mp4": write_mp4,
    ".webp": write_webp,
    ".gif": write_gif,
    ".png": write_png,
}
"""By ending of the file."""
SMALL = (".webp", ".gif")
"""Endings of files that grow fast with size and number of pictures."""
STILL = ".png"
"""The ending of a file with one picture: the last."""


# From a playback to the shots that MuJoCo paints: no simulation, the recorded poses and wheel speeds.


def shots_of(playback: Playback, film: Film, body: BodyShape, size: tuple[int, int]) -> Shots:
    """The shots of a film, `size` pixels wide and high."""
    times = film.times(playback)
    instants = playback.instants(times)
    first, last = playback.instants(np.array(film.span(playback))).tolist()
    plans = playback.plans[instants, :, :2] if playback.plans.size else np.empty((len(times), 0, 2))
    angles = wheel_angles(playback, body)
    return Shots(
        time=times,
        poses=_held(playback.at(times)),
        wheel_angles=np.column_stack([np.interp(times, playback.time, column) for column in angles.T]),
        passed=instants + 1 - first,
        plans=plans,
        way=playback.pose[first : last + 1, :2],
        reference=playback.reference[:, :2],
        band=metric_settings().band,
        body=body,
        surface=film.surface,
        camera=film.camera,
        size=size,
    )


def wheel_angles(playback: Playback, body: BodyShape) -> FloatArray:
    """(n, 4) angles [rad] from the measured wheel speeds; without them from the motion, as if nothing slipped."""
    rolling = WheelKinematics(body.wheel_radius, body.track).wheel_speeds(playback.twist)
    speeds = playback.wheel_speeds if playback.wheel_speeds.size else rolling
    speeds = np.nan_to_num(np.where(np.isfinite(speeds), speeds, rolling))
    steps = np.diff(playback.time)[:, None] * 0.5 * (speeds[1:] + speeds[:-1])
    return np.concatenate([np.zeros((1, 4)), np.cumsum(steps, axis=0)])


def _held(poses: FloatArray) -> FloatArray:
    """Where nothing is known the last known pose, and before that the first."""
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    if not known.size:
        return np.nan_to_num(poses)
    last = np.maximum(np.searchsorted(known, np.arange(len(poses)), side="right") - 1, 0)
    return np.asarray(poses[known[last]])
