"""A kind of YAML file and its shipped files."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class FileKind:
    """One kind of file.

    Attributes
    ----------
    name
        Name of the kind.
    folder
        Folder of the shipped files, or one file with an entry per name (`models.named_file.EntryFile`).
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

    @property
    def texts(self) -> dict[str, str]:
        """Text of each shipped file or entry, as in a file of the user, by name."""
        if self.folder.suffix:
            _, *parts = re.split(r"^(\w+):$", self.folder.read_text(encoding="utf-8"), flags=re.MULTILINE)
            return {name: textwrap.dedent(text).lstrip() for name, text in zip(parts[::2], parts[1::2], strict=True)}
        return {path.stem: path.read_text(encoding="utf-8") for path in self.files}
