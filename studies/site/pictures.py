"""Pictures of the documents that no study leaves: drawn by commands that a reader can type.

Run as ``python -m studies.site.pictures [NAME ...]``, from the top of the repository.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked

FOLDER = Path("docs/pictures")
# Figures have few colours; a palette takes a third of the room.
_COLOURS = 64


class SitePicture(StrictModel):
    """What draws a picture."""

    commands: list[str]
    shown: str


class Pictures(StrictModel):
    """Schema of `pictures.yaml`, by name."""

    pictures: dict[str, SitePicture]


def listed() -> dict[str, SitePicture]:
    """The pictures by name; raises ConfigError on a mistake in the file."""
    return load_checked(Pictures, Path(__file__).with_name("pictures.yaml")).pictures


def draw(picture: SitePicture, target: Path) -> None:
    """Run the commands in a folder of their own, and write what they drew to `target`.

    Raises
    ------
    subprocess.CalledProcessError
        If a command fails, other than by a drive that does not complete.
    """
    command = [sys.executable, "-c", "from diffdrive_mpc.app.cli import main; main()"]
    with TemporaryDirectory() as folder:
        for line in picture.commands:
            done = subprocess.run([*command, *shlex.split(line)], cwd=folder, check=False, stdout=subprocess.DEVNULL)
            # A drive that does not complete gives 1; pictures show such drives, too.
            if done.returncode > 1:
                done.check_returncode()
        with Image.open(Path(folder) / picture.shown) as drawn:
            drawn.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE).save(target, optimize=True)


def main(names: list[str]) -> None:
    """Draw the pictures of these names, or all of them."""
    FOLDER.mkdir(exist_ok=True)
    for name, picture in listed().items():
        if not names or name in names:
            draw(picture, FOLDER / f"{name}.png")


if __name__ == "__main__":
    main(sys.argv[1:])
