"""Tables generated from declarations are current and complete."""

import os
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from diffdrive_mpc.mpc.config.described import feature_rows, schema_rows
from studies.documents import declared_tables
from studies.site.pictures import FOLDER, POSTER, load_pictures

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", declared_tables.PAGES)
def test_page_shows_the_declared_tables(name):
    page = (DOCS / name).read_text(encoding="utf-8")
    assert declared_tables.with_tables(name, page) == page, "run: python -m studies.documents.declared_tables"


def test_every_parameter_has_a_row_with_unit_default_and_advice():
    lines = [line for line in declared_tables.parameter_tables().splitlines() if line.startswith("| `")]
    every = [row for row in (*schema_rows(), *feature_rows()) if not row.key.startswith("terms")]
    # Lists, which come only from files, are in the last table.
    controller = sorted(every, key=lambda row: row.default.startswith("["))
    rows = [*declared_tables.node_rows(), *chain(*declared_tables.part_rows().values()), *controller]
    assert [line.split("`")[1] for line in lines] == [row.key for row in rows]
    for line in lines:
        _, _, unit, default, _, meaning, when, _ = line.replace("\\|", "¦").split("|")
        assert default.strip() and meaning.strip() and when.strip(), line
        assert unit.strip() or "provenance" in line, line


ROOT = Path(__file__).parents[2]


def test_every_listed_picture_is_committed():
    names = {POSTER, *load_pictures()}
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
