"""One run on its way to whoever drives it."""

from __future__ import annotations

import platform
from dataclasses import dataclass

from diffdrive_mpc.bench.campaign.definition import Definition
from diffdrive_mpc.bench.campaign.drive import drive
from diffdrive_mpc.bench.campaign.identity import LIBRARIES, identify, key_of
from diffdrive_mpc.bench.campaign.outcome import Row
from diffdrive_mpc.bench.errors import StudyFailedError


class OtherVersionError(StudyFailedError):
    """Who drives a run has other code, libraries or files than who asked for it."""


@dataclass(frozen=True)
class Task:
    """A run, and the key under which it is kept."""

    definition: Definition
    key: str

    @classmethod
    def of(cls, definition: Definition) -> Task:
        """The task for a run."""
        return cls(definition, key_of(definition))

    @property
    def identity(self) -> dict[str, object]:
        """What the key is the hash of."""
        return identify(self.definition)


def do(task: Task) -> Row:
    """Drive the run and give its row; raises OtherVersionError where it would not be the run that was asked for."""
    if key_of(task.definition) != task.key:
        raise OtherVersionError(
            f"{platform.node()} has another version of this product, of Python or of {', '.join(LIBRARIES)}, or other "
            "files than where the campaign was started; install the same, and share the files that the campaign names"
        )
    return drive(task.definition)
