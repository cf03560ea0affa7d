"""Conversion of tutorials from Markdown to notebooks, which draw the pictures of the tutorials.

`python -m studies.site.notebooks`, run in the root folder of the repository, writes the notebooks without outputs next
to the tutorials, executes them, and writes the pictures of the tutorials. Git ignores the notebooks.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
from nbclient import NotebookClient

TUTORIALS = Path("docs/tutorials")

# A notebook omits the pictures of its tutorial, because its cells draw them, and the sentence about the notebook.
_PICTURE = re.compile(r"^!\[[^\]]*\]\((?P<file>[\w-]+\.png)\)\n\n?", re.MULTILINE)
_REFERENCE = re.compile(r" The notebook of this page, `(?P<file>[\w-]+\.ipynb)`, has the same steps; [^.]*\.")
_FILE = re.compile(r"^```yaml\n# file: (\S+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


# First cell of a notebook with shell commands.
_SETUP = """```python
# The commands below run in the environment of this notebook; their tables are plain text.
import os
import sys

path = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
os.environ.update(PATH=path, FORCE_COLOR="", COLUMNS="110")
```
"""


def notebook_text(markdown: str) -> str:
    """Convert a tutorial to a notebook in JSON; its cells run Python and shell commands, and write files."""
    source = _FILE.sub(r"```python\n%%writefile \1\n\2```", _REFERENCE.sub("", _PICTURE.sub("", markdown)))
    if "```sh\n" in source:
        title, _, rest = source.partition("\n")
        source = f"{title}\n\n{_SETUP}{rest}"
    notebook = jupytext.reads(source, fmt="md")
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number}", {}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    notebook.metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return str(jupytext.writes(notebook, fmt="ipynb")) + "\n"


def with_notebooks(documents: Mapping[str, str], out: Path) -> dict[str, str]:
    """Write the notebooks of the tutorials in `documents` to the folder `out` of the site.

    Return the documents with a link to the notebook in each tutorial.
    """
    linked = dict(documents)
    for path, markdown in documents.items():
        reference = _REFERENCE.search(markdown)
        if reference and path.startswith("docs/tutorials/"):
            name = reference["file"]
            (out / "tutorials" / name).write_text(notebook_text(markdown), encoding="utf-8")
            linked[path] = markdown.replace(f"`{name}`", f"[`{name}`]({name})", 1)
    return linked


def execute(notebook: str, folder: Path) -> list[bytes]:
    """Execute a notebook in `folder` and return the pictures (PNG) in its outputs.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell fails; the message names the cell and the error.
    """
    source_notebook = jupytext.reads(notebook, fmt="ipynb")
    client = NotebookClient(source_notebook, timeout=600, resources={"metadata": {"path": folder}})
    executed_notebook: Any = client.execute()
    outputs = [output.get("data", {}) for cell in executed_notebook.cells for output in cell.get("outputs", [])]
    return [base64.b64decode(data["image/png"]) for data in outputs if "image/png" in data]


def pictures(markdown: str) -> list[str]:
    """List the picture files of a tutorial in the order of the outputs of its notebook."""
    return [match["file"] for match in _PICTURE.finditer(markdown)]


def write_all(folder: Path) -> None:
    """Write the notebook and the pictures of every tutorial in `folder`."""
    for page in sorted(folder.glob("*.md")):
        markdown = page.read_text(encoding="utf-8")
        if "```python" not in markdown:
            continue
        notebook = notebook_text(markdown)
        page.with_suffix(".ipynb").write_text(notebook, encoding="utf-8")
        with TemporaryDirectory() as scratch:
            images = execute(notebook, Path(scratch))
        for name, picture in zip(pictures(markdown), images, strict=True):
            (folder / name).write_bytes(picture)


if __name__ == "__main__":
    write_all(TUTORIALS)
