"""Kinds of YAML files and their shipped files."""

from __future__ import annotations

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

import diffdrive_mpc_extras
from diffdrive_mpc.app.schemas import PACKAGE
from diffdrive_mpc.models.function_structure import function_structures

_EXTRAS = Path(diffdrive_mpc_extras.__file__).parent


@dataclass(frozen=True)
class FileKind:
    """Kind of file.

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


def _kind(name: str, folder: str) -> FileKind:
    return FileKind(name, PACKAGE / folder)


def _configurations() -> tuple[Path, ...]:
    """Return the configurations of the structures in packages."""
    return tuple(structure.config for structure in function_structures().values() if structure.config)


def _models() -> FileKind:
    elsewhere: tuple[Path, ...] = tuple(
        structure.shipped for structure in function_structures().values() if structure.shipped
    )
    patterns = ("*.yaml", "robots/*.yaml")
    return FileKind("model", PACKAGE / "models" / "parameters", patterns, ("robot.yaml",), elsewhere)


KINDS: dict[str, FileKind] = {
    kind.name: kind
    for kind in (
        FileKind("controller", PACKAGE / "mpc" / "config" / "parameters", elsewhere=_configurations()),
        _kind("trajectory", "mpc/trajectories/built_in"),
        _models(),
        _kind("mapping", "models/logs/mappings"),
        _kind("stated-robot", "models/stated_robots.yaml"),
        _kind("robot", "sim/plants/robots.yaml"),
        _kind("surface", "sim/plants/surfaces.yaml"),
        _kind("sensors", "sim/sensing/sensor_sets.yaml"),
        _kind("scenario", "sim/disturbances/scenarios.yaml"),
        FileKind("drive", _EXTRAS / "turn_costs" / "drives"),
        FileKind("terrain", _EXTRAS / "terrain" / "terrains"),
        FileKind("turn-costs", _EXTRAS / "turn_costs" / "floors"),
        FileKind("vehicle", _EXTRAS / "turn_costs" / "vehicles"),
        FileKind("world", _EXTRAS / "worlds" / "shipped"),
    )
}
"""File kinds by name."""
