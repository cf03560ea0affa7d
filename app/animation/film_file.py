"""Pictures into a file: MP4 by ffmpeg, animated WebP or GIF by Pillow, or the last picture as PNG."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.sim.view.offscreen import Picture

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
    with tempfile.TemporaryFile() as said:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=said) as process:
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
            said.seek(0)
            lines = said.read().decode(errors="replace").split("\n")
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
