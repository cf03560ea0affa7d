"""A kind of YAML file that the command line offers by the names of its shipped files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class FileKind:
    """One kind of file.

    Attributes
    ----------
    name
        Name of the kind, which completion uses.
    folder
        Folder of the shipped files.
    patterns
        Patterns of the shipped files, relative to `folder`.
    excluded
        Names of files that match the patterns and are of another kind.
    elsewhere
        Shipped files in other folders.
    """

    name: str
    folder: Path
    patterns: tuple[str, ...] = ("*.yaml",)
    excluded: tuple[str, ...] = ()
    elsewhere: tuple[Path, ...] = ()

    @property
    def files(self) -> list[Path]:
        """Shipped files of this kind."""
        paths = (path for pattern in self.patterns for path in sorted(self.folder.glob(pattern)))
        return [*(path for path in paths if path.name not in self.excluded), *self.elsewhere]
