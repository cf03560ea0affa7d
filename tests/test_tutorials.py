"""Tutorials do what they say: their notebooks are those of their pages, run, and draw what the pages show."""

from pathlib import Path

import pytest

from studies.site.notebooks import executed, notebook_text, pictures

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
TUTORIALS = sorted(path for path in FOLDER.glob("*.md") if path.stem != "index")


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_notebook_is_that_of_the_page_and_draws_what_it_shows(page, tmp_path):
    markdown = page.read_text(encoding="utf-8")
    notebook = page.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert notebook == notebook_text(markdown), "run `make notebooks`"
    assert '"outputs": []' in notebook
    shown = pictures(markdown)
    assert shown
    assert all((FOLDER / name).is_file() for name in shown)
    assert len(executed(notebook, tmp_path)) == len(shown)


def test_every_tutorial_is_listed_and_names_its_notebook():
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    for page in TUTORIALS:
        assert f"({page.name})" in index
        assert f"]({page.stem}.ipynb)" in page.read_text(encoding="utf-8").split("\n\n")[1]
