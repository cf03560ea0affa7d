"""The gallery shows what its commands make."""

from pathlib import Path

import pytest
from PIL import Image

from commands import invoke
from diffdrive_mpc.app.cli import app
from studies.gallery.build import FOLDER, PAGE, load_gallery

DOCS = Path(__file__).parents[2] / "docs"
PICTURES = load_gallery().pictures
LARGEST, ALL_TOGETHER = 500_000, 4_000_000


def test_the_page_is_that_of_the_file():
    page = (DOCS / PAGE).read_text(encoding="utf-8")
    assert load_gallery().page(page) == page


def test_pictures_are_there_and_small():
    sizes = {picture.file: (DOCS / FOLDER / picture.file).stat().st_size for picture in PICTURES}
    assert max(sizes.values()) < LARGEST, sizes
    assert sum(sizes.values()) < ALL_TOGETHER
    assert set(sizes) == {path.name for path in (DOCS / FOLDER).iterdir()}


@pytest.mark.system("rendering")
@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.name)
def test_each_command_makes_its_picture(picture, tmp_path, monkeypatch):
    """The first tenths of a second of it, which takes less time."""
    monkeypatch.chdir(tmp_path)
    command = load_gallery().command(picture)
    invoke(app, *command[1:], "--to", "0.2")
    with Image.open(picture.file) as made, Image.open(DOCS / FOLDER / picture.file) as shown:
        assert made.size == shown.size
        assert made.format == shown.format
