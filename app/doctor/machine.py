"""What is read of the computer: files of the system, variables, programs. What cannot be read is not there."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import shutil
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from diffdrive_mpc.models.checked_yaml import StrictModel, load_checked
from diffdrive_mpc.models.robot import Positive

_CLOCK_UNSYNCHRONISED = 5
_TIMEX_BYTES = 512


@dataclass(frozen=True)
class Machine:
    """The computer as this process sees it.

    Attributes
    ----------
    root
        Folder in which `proc`, `sys` and `dev` lie.
    environ
        The environment variables.
    """

    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=lambda: os.environ)

    def text(self, path: str) -> str | None:
        """A file of the system without white space around it; None where it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def texts(self, pattern: str) -> list[str]:
        """The files that match, those that can be read."""
        contents = []
        with suppress(OSError):
            contents = [self.text(str(path.relative_to(self.root))) for path in sorted(self.root.glob(pattern))]
        return [text for text in contents if text]

    def there(self, path: str) -> bool:
        """Whether there is such a file or folder."""
        try:
            return (self.root / path).exists()
        except OSError:
            return False

    def number(self, path: str) -> int | None:
        """A file that holds one whole number."""
        text = self.text(path)
        return int(text) if text is not None and text.lstrip("-").isdigit() else None

    def values(self, path: str) -> dict[str, str]:
        """A file with lines `key : value`; of a key that is there more than once, the first."""
        entries: dict[str, str] = {}
        for line in (self.text(path) or "").splitlines():
            key, _, value = line.partition(":")
            entries.setdefault(key.strip(), value.strip())
        return entries

    def program(self, name: str) -> str | None:
        """Where a program is."""
        return shutil.which(name, path=self.environ.get("PATH", ""))

    def variable(self, name: str) -> str:
        """A variable; empty where it is not set."""
        return self.environ.get(name, "")

    def free(self, folder: str) -> int | None:
        """Bytes free in a folder."""
        try:
            return shutil.disk_usage(self.root / folder).free
        except OSError:
            return None

    def installed(self, distribution: str) -> str | None:
        """Version of an installed package."""
        try:
            return version(distribution)
        except PackageNotFoundError:
            return None

    def requirements(self) -> list[str]:
        """What this project says that it needs, with its extras."""
        try:
            return requires("diffdrive-mpc") or []
        except PackageNotFoundError:
            return []

    def library(self, name: str) -> str | None:
        """Name of a shared library by that of its function."""
        return ctypes.util.find_library(name)

    def limit(self, name: str) -> int | None:
        """A limit of this process as `resource` names it; -1: none. None where the system has no such."""
        if sys.platform == "win32":
            return None
        import resource  # noqa: PLC0415 - not everywhere

        kind = getattr(resource, name, None)
        return None if kind is None else resource.getrlimit(kind)[0]

    def user_id(self) -> int | None:
        """Of this process; 0 may do everything."""
        return os.geteuid() if hasattr(os, "geteuid") else None

    def clock_synchronised(self) -> bool | None:
        """Whether the system's clock follows another one, as the kernel says."""
        with suppress(OSError, AttributeError):
            state = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
            return None if state < 0 else state != _CLOCK_UNSYNCHRONISED
        return None

    def lateness(self, period: float, duration: float) -> list[float]:
        """By how much this process wakes too late, tick by tick [s]."""
        late = []
        start = time.perf_counter()
        for tick in range(1, round(duration / period) + 1):
            due = start + tick * period
            time.sleep(max(0.0, due - time.perf_counter()))
            late.append(time.perf_counter() - due)
        return late


# What one look found.


Status = Literal["ok", "warn", "missing", "unknown"]


@dataclass(frozen=True)
class MachineFinding:
    """One row of the table.

    Attributes
    ----------
    what
        What was looked at.
    status
        "ok"; "warn", it costs something; "missing"; "unknown", it could not be seen, as often in a container.
    found
        What there is.
    means
        What that means, and what to do about it.
    needed
        Whether the controller cannot run while this is missing.
    """

    what: str
    status: Status
    found: str
    means: str
    needed: bool = False


class DoctorSettings(StrictModel):
    """What is called enough; units stand in the file."""

    jitter_period: Positive
    jitter_time: Positive
    most_lateness: Positive
    least_memory: Positive
    least_disk: Positive
    least_shared_memory: Positive
    least_rtprio: Positive


@cache
def doctor_settings() -> DoctorSettings:
    """Read `settings.yaml`; raises ConfigError when it has a mistake."""
    return load_checked(DoctorSettings, Path(__file__).with_name("settings.yaml"))


def in_bytes(number: float) -> str:
    """A number of bytes in a unit that is read easily."""
    return f"{number / 1e9:.1f} GB" if number >= 1e9 else f"{number / 1e6:.0f} MB"
