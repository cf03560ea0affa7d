"""Installation instructions and settings refer to existing things."""

import os
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

from studies.site.licences import PAGE, insert_table
from studies.speed.process.environment import REQUIREMENTS

ROOT = Path(__file__).parents[1]
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
# Every Debian system has these commands, but the path of the tests may not contain their folders.
SHELL = {"capture_output": True, "text": True, "env": {"PATH": os.defpath}}
PYTHONS = [f"3.{minor}" for minor in (11, 12, 13, 14)]


def instructions(keyword):
    return [line.split(maxsplit=1)[1] for line in DOCKERFILE.splitlines() if line.startswith(f"{keyword} ")]


def test_image_copies_only_existing_files():
    for instruction in instructions("COPY"):
        *sources, _ = shlex.split(instruction)
        assert all((ROOT / source).exists() for source in sources), instruction
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not {"requirements.txt", "ros", "docker", "src", "pyproject.toml"} & set(ignored)


def test_pins_of_the_image_equal_those_of_the_project():
    """The command of the image generates them from the file with hashes."""
    (command,) = re.findall(r"sed .*?> \S+", DOCKERFILE)
    shell = command.replace("/source", str(ROOT)).rpartition(">")[0]
    pins = subprocess.run(["/bin/sh", "-c", shell], check=True, **SHELL).stdout.splitlines()
    assert len(pins) > 100
    assert all(re.match(r"[a-z0-9][\w.\[\]-]*==\S+( ;.*)?$", pin, re.IGNORECASE) for pin in pins)
    (numpy,) = (pin for pin in pins if pin.startswith("numpy==1.26"))
    assert "3.12" in numpy


def test_dependencies_are_pinned_for_every_supported_python():
    environments = " ".join(PROJECT["tool"]["uv"]["environments"])
    assert all(python in environments for python in PYTHONS[1:])
    pins = (ROOT / "requirements.txt").read_text(encoding="utf-8")
    assert re.search(r"^casadi==\S+ ; python_full_version < '3\.15'", pins, re.MULTILINE)


# External packages: pinned by their contents, with their licences.


LISTS = (
    ROOT / "requirements.txt",
    REQUIREMENTS,
    *(ROOT / ".ci" / f"{name}.txt" for name in ("colcon", "tools", "lab", "coverage")),
)


@pytest.mark.parametrize("file", LISTS, ids=lambda file: f"{file.parent.name}/{file.name}")
def test_every_package_is_pinned_with_the_hashes_of_its_files(file: Path) -> None:
    """Each package has one version and at least one hash; index addresses are omitted, since none suits every user."""
    text = file.read_text(encoding="utf-8")
    assert "://" not in text
    parts = re.split(r"^(?=[A-Za-z0-9])", re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE), flags=re.MULTILINE)
    packages = [part for part in parts if part.strip()]
    assert packages
    for part in packages:
        assert re.match(r"[A-Za-z0-9._-]+==[^ ]+", part), part
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", part), part


def test_page_lists_the_licences_of_installed_packages() -> None:
    """The table equals the table generated from the installed packages."""
    page = PAGE.read_text(encoding="utf-8")
    assert insert_table(page) == page
    assert "| casadi | GNU Lesser General Public License v3" in page
