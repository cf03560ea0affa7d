"""Virtual environment of peers whose packages conflict with ours, created once in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from diffdrive_mpc.models.compiled.cache import user_folder
from studies.speed.process.subject import SubjectError

REQUIREMENTS = Path(__file__).parents[1] / "subjects" / "requirements.txt"
_READY = ".ready"
"""Name of the file that marks a complete environment."""
_FIRST_PACKAGE = "comma-deps-acados"
"""Package that is installed first; it contains parts of an older CasADi, which a later package must overwrite."""


@dataclass(frozen=True)
class PeerEnvironment:
    """Path of the Python interpreter, and environment variables for its processes."""

    python: str
    variables: dict[str, str]


def peer_environment(folder: Path | None = None) -> PeerEnvironment:
    """Return the environment in `folder`, by default in the user's cache folder; create it if it is missing.

    Raise SubjectError if the environment cannot be created, for example because the package index is not accessible or
    has no wheel for this operating system.
    """
    digest = hashlib.sha256(REQUIREMENTS.read_bytes() + sys.version.encode()).hexdigest()[:16]
    folder = (folder or user_folder() / "peers" / digest).resolve()
    if not (folder / _READY).is_file():
        _create(folder)
    package = next(folder.glob("lib/python*/site-packages/acados"))
    _link_templates(package)
    return PeerEnvironment(
        python=str(folder / "bin" / "python"),
        variables={
            "ACADOS_SOURCE_DIR": str(package / "install"),
            "TERA_PATH": str(package / "install" / "bin" / "t_renderer"),
            "LD_LIBRARY_PATH": str(package / "install" / "lib"),
            "PYTHONPATH": str(package),
        },
    )


def _create(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    _run(sys.executable, "-m", "venv", str(folder))
    pip = (
        str(folder / "bin" / "python"),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-deps",
        "--require-hashes",
    )
    first_list = folder / "first.txt"
    first_list.write_text(requirement_entry(_FIRST_PACKAGE, REQUIREMENTS.read_text(encoding="utf-8")), encoding="utf-8")
    _run(*pip, "--requirement", str(first_list))
    _run(*pip, "--requirement", str(REQUIREMENTS))
    (folder / _READY).touch()


def requirement_entry(name: str, requirements: str) -> str:
    """Return the entry of a package, its version and hashes, in a list of requirements.

    Raise SubjectError if the list does not contain the package.
    """
    match = re.search(rf"^{re.escape(name)}==(?:.*\\\n)*.*\n", requirements, re.MULTILINE)
    if match is None:
        raise SubjectError(f"the peers' environment cannot be created: {name} is not in {REQUIREMENTS.name}")
    return match[0]


def _run(*command: str) -> None:
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "LD_LIBRARY_PATH")}
    process = subprocess.run(command, capture_output=True, text=True, env=variables, check=False)
    if process.returncode:
        lines = [line.strip().removeprefix("ERROR: ") for line in process.stderr.splitlines() if line.strip()]
        raise SubjectError(f"the peers' environment cannot be created: {lines[-1] if lines else 'no reason given'}")


def _link_templates(package: Path) -> None:
    """Link the templates to the path at which the code generator of acados expects them."""
    folder = package / "install" / "interfaces" / "acados_template"
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "acados_template").exists():
        (folder / "acados_template").symlink_to(package / "acados_template", target_is_directory=True)
