"""Tutorials: notebooks run and draw the figures of their pages."""

from pathlib import Path

import numpy as np
import pytest
from recorded_drive import read_drive
from two_processes import own_domain

from diffdrive_mpc import load_config, load_trajectory
from studies.site.notebooks import execute, notebook_text, pictures, with_notebooks

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
JACKAL = "from-bag-to-robot"
TUTORIALS = sorted(FOLDER.glob("*.md"))


@pytest.mark.system
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_notebook_draws_the_figures_of_its_page(page, tmp_path, monkeypatch):
    markdown = page.read_text(encoding="utf-8")
    notebook = notebook_text(markdown)
    assert '"outputs": []' in notebook
    figures = pictures(markdown)
    assert figures
    assert all((FOLDER / name).is_file() for name in figures)
    for name, value in own_domain(tmp_path).items():
        monkeypatch.setenv(name, value)
    assert len(execute(notebook, tmp_path)) == len(figures)
    if page.stem == JACKAL:
        check_jackal(tmp_path)


def check_jackal(folder):
    """Check that the report permits driving, and that the drive over DDS is completed inside the predicted tube."""
    assert "May I drive? Yes" in (folder / "my_jackal" / "report.md").read_text(encoding="utf-8")
    config = load_config(folder / "my_jackal" / "config.yaml")
    reference = load_trajectory(folder / "my_jackal" / "first_circle.yaml", config)
    drive = read_drive(folder / "driven", reference, config.sample_time)
    tube = np.genfromtxt(folder / "predicted" / "predicted-error.csv", delimiter=",", names=True)
    assert drive.metrics.completed
    assert 0.001 < drive.metrics.lateral_max_m < np.min(tube["lateral_everywhere"])


def test_every_tutorial_is_listed_and_the_site_links_its_notebook(tmp_path):
    (tmp_path / "tutorials").mkdir()
    documents = {f"docs/tutorials/{page.name}": page.read_text(encoding="utf-8") for page in TUTORIALS}
    linked = with_notebooks(documents, tmp_path)
    start = (FOLDER.parent / "why.md").read_text(encoding="utf-8")
    for page in TUTORIALS:
        assert f"(tutorials/{page.name})" in start
        assert f"]({page.stem}.ipynb)" in linked[f"docs/tutorials/{page.name}"].split("\n\n")[1]
        assert f"{page.stem}.ipynb" not in (tmp_path / "tutorials" / f"{page.stem}.ipynb").read_text(encoding="utf-8")
