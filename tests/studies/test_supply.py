"""What comes from elsewhere: pinned by its contents, and under which licence."""

import re
from pathlib import Path

import pytest

from studies.site.licences import PAGE, with_table
from studies.speed.process.environment import REQUIREMENTS

ROOT = Path(__file__).parents[2]
LISTS = (
    ROOT / "requirements.txt",
    REQUIREMENTS,
    *(ROOT / ".ci" / f"{name}.txt" for name in ("colcon", "tools", "lab")),
)


@pytest.mark.parametrize("file", LISTS, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_every_package_is_pinned_with_the_hashes_of_its_files(file: Path) -> None:
    """One version, and one hash at least, for each; no address of an index, as nobody's is everybody's."""
    text = file.read_text(encoding="utf-8")
    assert "://" not in text
    parts = re.split(r"^(?=[A-Za-z0-9])", re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE), flags=re.MULTILINE)
    packages = [part for part in parts if part.strip()]
    assert packages
    for part in packages:
        assert re.match(r"[A-Za-z0-9._-]+==[^ ]+", part), part
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", part), part


@pytest.mark.parametrize("file", LISTS[1:], ids=lambda file: f"{file.parent.name}/{file.name}")
def test_what_was_asked_for_is_what_is_pinned(file: Path) -> None:
    """The lists that people write are those that were pinned."""
    text = file.read_text(encoding="utf-8")
    asked = file.with_suffix(".in").read_text(encoding="utf-8").splitlines()
    for line in asked:
        name, _, version = re.match(r"([\w.-]+)([=<>]+)?(.*)", line).groups() if line[0] != "#" else ("", "", "")
        assert f"\n{name}==" in f"\n{text}" or not name
        if "==" in line:
            assert f"\n{name}=={version} " in f"\n{text}"


def test_the_page_tells_the_licences_of_what_is_installed() -> None:
    """As the packages state them now."""
    page = PAGE.read_text(encoding="utf-8")
    assert with_table(page) == page
    assert "| casadi | GNU Lesser General Public License v3" in page
