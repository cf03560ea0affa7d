"""Description of the computer that produced a result, without names of hosts, users or paths."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from diffdrive_mpc.bench.runner import available_cores

PACKAGES = ("numpy", "scipy", "casadi", "osqp", "daqp", "mujoco", "control", "joblib")
"""Packages whose version can influence a result."""


def describe_run(wall_time: float) -> dict[str, Any]:
    """Describe the run that produced a result: version, revision, date, computer and duration `wall_time` [s]."""
    return {
        "project": "diffdrive-mpc",
        "version": project_version(),
        "revision": git_revision(),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": describe_machine(),
        "wall_time_s": round(wall_time, 1),
    }


def describe_machine() -> dict[str, object]:
    """Describe the processor, the cores, the operating system, Python and the packages."""
    return {
        "cpu": _processor(),
        "cores": available_cores(),
        "os": _system(),
        "python": platform.python_version(),
        "packages": {name: package_version(name) for name in PACKAGES},
    }


def project_version() -> str:
    """Return the version of this project."""
    return package_version("diffdrive-mpc")


def git_revision() -> str | None:
    """Return the Git revision of this checkout, with "+" if it has uncommitted changes; None outside a checkout."""
    root = Path(__file__).resolve().parents[1]
    checkout_root = _git("rev-parse", "--show-toplevel")
    revision = _git("rev-parse", "--short=12", "HEAD")
    if not revision or not checkout_root or Path(checkout_root).resolve() != root:
        return None
    return revision + ("+" if _git("status", "--porcelain", "--untracked-files=no") else "")


def _git(*arguments: str) -> str:
    try:
        completed = subprocess.run(
            ["git", *arguments], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return completed.stdout.strip()


def package_version(package: str) -> str:
    """Return the version of a package, or "not installed"."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _system() -> str:
    try:
        name = platform.freedesktop_os_release().get("PRETTY_NAME", "")
    except OSError:
        name = ""
    kernel = f"{platform.system()} {platform.release()}"
    return f"{name} ({kernel})" if name else kernel
