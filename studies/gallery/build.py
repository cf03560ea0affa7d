"""Makes docs/gallery and its part of docs/see.md: `python -m studies.gallery.build docs`, or `make gallery`."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from pydantic import Field

from diffdrive_mpc.bench.report_folder import staged
from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.whole_file import whole_file
from studies.documents.documents import insert

FOLDER = "gallery"
PAGE = "see.md"


class GalleryPicture(StrictModel):
    """One picture and what is said of it."""

    name: str = Field(description="of its place on the page")
    title: str = Field(description="heading")
    words: str = Field(description="what can be seen")
    arguments: str = Field(description="of `diffdrive-mpc simulate`")

    @property
    def file(self) -> str:
        """Name of the picture's file."""
        words = shlex.split(self.arguments)
        return words[words.index("--animate") + 1]


class Gallery(StrictModel):
    """All pictures in their order."""

    film: str = Field(description="arguments that all films share, and still pictures do without")
    pictures: list[GalleryPicture]

    def command(self, picture: GalleryPicture) -> list[str]:
        """The words of the command that makes a picture."""
        film = [] if picture.file.endswith(".png") else shlex.split(self.film)
        return ["diffdrive-mpc", "simulate", *shlex.split(picture.arguments), *film]

    def page(self, document: str) -> str:
        """`document` with all pictures between its markers."""
        return insert(document, "\n\n".join(map(self._section, self.pictures)), FOLDER)

    def _section(self, picture: GalleryPicture) -> str:
        words = " ".join(picture.words.split())
        show = f"![{picture.title}]({FOLDER}/{picture.file})"
        return f"### {picture.title}\n\n{words}\n\n{show}\n\n    {shlex.join(self.command(picture))}"


@cache
def load_gallery() -> Gallery:
    """Read the shipped gallery; raises ConfigError when the file has a mistake."""
    return load_checked(Gallery, Path(__file__).parent / "gallery.yaml")


def build(documents: Path) -> None:
    """Make every picture, and show it in the page, in this folder.

    Raises
    ------
    subprocess.CalledProcessError
        If a command fails; then nothing is changed.
    """
    gallery = load_gallery()
    with staged(documents / FOLDER) as folder, tempfile.TemporaryDirectory() as apart:
        for picture in gallery.pictures:
            print(shlex.join(gallery.command(picture)), flush=True)  # noqa: T201 - minutes: it says where it is
            words = ["-c", "from diffdrive_mpc.app.cli import main; main()", *gallery.command(picture)[1:]]
            subprocess.run([sys.executable, *words], cwd=apart, check=True, stdout=subprocess.DEVNULL, env=os.environ)
            Path(apart, picture.file).replace(folder / picture.file)
    with whole_file(documents / PAGE) as draft:
        draft.write_text(gallery.page((documents / PAGE).read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]))
