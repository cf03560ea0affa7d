"""A kind of YAML file that users write: where the shipped ones lie, and where their JSON Schema does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import BaseModel

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class FileKind:
    """One kind of file.

    Attributes
    ----------
    name
        Word of the command line.
    room
        The room that reads it.
    what
        What such a file says, in a few words.
    given
        Where such a file is given.
    shipped
        Patterns of the files that ship, from the room.
    besides
        Names of files that match them and are of another kind.
    elsewhere
        Files that ship in other rooms.
    reader
        Of a plug-in's kind: what its files are checked by.
    """

    name: str
    room: str
    what: str
    given: str
    shipped: tuple[str, ...] = ()
    besides: tuple[str, ...] = ()
    elsewhere: tuple[Path, ...] = ()
    reader: Callable[[], type[BaseModel]] | None = None

    @property
    def file(self) -> Path:
        """The schema."""
        return PACKAGE / self.room / "schemas" / f"{self.name}.schema.json"

    @property
    def files(self) -> list[Path]:
        """The shipped files of this kind."""
        paths = (path for pattern in self.shipped for path in sorted((PACKAGE / self.room).glob(pattern)))
        return [*(path for path in paths if path.name not in self.besides), *self.elsewhere]

    def text(self) -> str:
        """The schema as it ships; raises OSError in a clone where `make schemas` has not been run."""
        return self.file.read_text(encoding="utf-8")
