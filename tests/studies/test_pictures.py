"""Pictures of the documents."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from studies.site.pictures import FOLDER, POSTER, listed

ROOT = Path(__file__).parents[2]


def test_every_listed_picture_is_committed():
    names = {POSTER, *listed()}
    assert names <= {path.stem for path in (ROOT / FOLDER).glob("*.png")}


@pytest.mark.system("rendering")
def test_poster_shows_path_and_plan(tmp_path):
    code = "import pathlib, sys; from studies.site.pictures import draw_poster; draw_poster(pathlib.Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(tmp_path / "p.png")]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"MUJOCO_GL": "egl"}, check=True)
    with Image.open(tmp_path / "p.png") as drawn:
        red, green, blue = np.moveaxis(np.asarray(drawn.convert("RGB"), dtype=int), -1, 0)
    assert red.shape == (720, 1280)
    assert np.count_nonzero((red > 150) & (green < 120) & (blue < 60)) > 300  # the plan
    assert np.count_nonzero((blue > 90) & (red < 60)) > 5000  # the driven path and the deck
