"""Documents as a site: links, formulas, generated pages, and builds that fail on errors."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import typer

import diffdrive_mpc
from diffdrive_mpc.app.cli import app
from studies.site.command_line import command_line_page
from studies.site.reference import api_page
from studies.site.staging import stage, with_mathml, with_site_links

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("document", "link", "on_site"),
    [
        ("README.md", "docs/models.md#a-b", "models.md#a-b"),
        ("docs/why.md", "../README.md#how-well-it-tracks", "index.md#how-well-it-tracks"),
        ("docs/tutorials/own-parts.md", "../simulated-robot.md", "../simulated-robot.md"),
        ("docs/tutorials/own-parts.md", "../../examples/own_cost.py", "../files/examples/own_cost.py.md"),
        ("README.md", "https://example.org/docs/models.md", "https://example.org/docs/models.md"),
        ("docs/why.md", "#here", "#here"),
    ],
)
def test_repository_links_become_site_links(document, link, on_site):
    assert with_site_links(f"see [it]({link}), too", document) == f"see [it]({on_site}), too"


def test_formulas_become_mathml_and_code_is_unchanged():
    markdown = "with $a < b_{k+1}$, `$HOME` and `a$b`\n\n$$\n\\sqrt{2}\n$$\n\n```sh\necho $A $B\n```\n"
    page = with_mathml(markdown)
    assert "`$HOME` and `a$b`" in page
    assert page.endswith("```sh\necho $A $B\n```\n")
    formulas = [ElementTree.fromstring(formula) for formula in re.findall(r"<math.*?</math>", page, re.DOTALL)]
    assert [formula.get("display") for formula in formulas] == ["inline", "block"]
    assert ["".join(formula.itertext()) for formula in formulas] == ["a<bk+1", "2"]


def test_every_command_and_option_is_in_the_reference():
    page = command_line_page()
    sections = dict(re.findall(r"^## ([\w -]+?) \{.*?$(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL))
    for name, command in commands(typer.main.get_command(app)):
        for option in command.params:
            if option.opts[0].startswith("--") and option.name != "help":
                assert f"`{option.opts[0]}`" in sections[name], (name, option.opts)
    assert "| `--trajectory` | `circle` |" in sections["simulate"]
    assert "| `--seed` | `0` |" in sections["simulate"]


def commands(group, prefix=""):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield prefix + name, command


def test_every_public_name_is_in_the_reference_and_can_be_imported_as_shown():
    page = api_page()
    names = re.findall(r"^::: (\S+)$", page, re.MULTILINE)
    assert {name.rpartition(".")[2] for name in names} >= set(diffdrive_mpc.__all__)
    imported = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, imported)
    assert {name.rpartition(".")[2] for name in names} <= set(imported)


@pytest.mark.system
def test_dead_link_dead_anchor_and_unlisted_page_fail_the_build(tmp_path):
    for name in ("mkdocs.yml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    for name in ("examples", "src", "bench", "app", "studies"):
        (tmp_path / name).symlink_to(ROOT / name)
    page = tmp_path / "docs" / "lost.md"
    page.write_text("# Where?\n\n[a](nowhere.md) [b](why.md#nowhere) [c](../examples/nothing.py)\n", encoding="utf-8")
    stage(tmp_path, tmp_path / "out" / "site-pages")
    result = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    errors = [line for line in result.stderr.splitlines() if "lost.md" in line or "nowhere" in line]
    assert len(errors) == 4, result.stderr
