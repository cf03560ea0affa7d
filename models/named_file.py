"""Parameter files by a short name or by a path."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from diffdrive_mpc.models.checked_yaml import ConfigError, Schema, check, merge_mappings, read_yaml
from diffdrive_mpc.models.errors import wrong_type
from diffdrive_mpc.models.trust import check_trusted


def named_file(
    kind: str, folder: Path, name: str | Path, shipped: Sequence[str] | None = None, others: str = ""
) -> Path:
    """Resolve `name` to a file: a YAML file that ships in `folder`, or the user's own.

    Parameters
    ----------
    kind
        Content of the files, for the message.
    folder
        Folder of the shipped files.
    name
        Name of a shipped file without its ending, or a path.
    shipped
        Names of the shipped files; by default every YAML file in `folder`.
    others
        Other accepted values, for the message, which lists them after those names.

    Raises
    ------
    models.checked_yaml.ConfigError
        If there is neither; the message lists the shipped names and suggests the nearest.
    models.errors.ArgumentError
        If `name` is neither a text nor a path.
    models.trust.UntrustedFileError
        If it is a file that may not be opened, see `models.trust.only_trusted`.
    """
    known = shipped_names(folder) if shipped is None else shipped
    if not isinstance(name, (str, Path)):
        raise wrong_type(kind, "a name or the path of a file", name, f"give one of {', '.join(known)}, or a path")
    text = str(name)
    if text in known:
        return folder / f"{text}.yaml"
    check_trusted(name)
    if is_file(name):
        return Path(name)
    near = difflib.get_close_matches(text.lower(), known, n=1, cutoff=0.5)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    missing = "there is no such file; " if Path(text).suffix or os.sep in text else ""
    raise ConfigError(
        f"unknown {kind} '{text}': {missing}give one of {', '.join(known)}{others} or the path of a {kind} file{hint}"
    )


@dataclass(frozen=True)
class EntryFile:
    """Shipped YAML file with one entry per name; a file of the user holds one entry without its name.

    Attributes
    ----------
    kind
        Kind of the entries, for messages.
    path
        Path of the shipped file.
    """

    kind: str
    path: Path

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the shipped entries, sorted."""
        return tuple(sorted(_entries(self.path)))

    def read(self, name: str | Path) -> tuple[Any, str]:
        """Return the values of a shipped name or of a user's file, and their place for messages.

        Raises
        ------
        models.checked_yaml.ConfigError
            If there is no such entry or file, or the file cannot be read; see also `named_file`.
        """
        entries = _entries(self.path)
        if isinstance(name, (str, Path)) and str(name) in entries:
            return deepcopy(entries[str(name)]), f"{self.path}, entry '{name}'"
        path = named_file(self.kind, self.path, name, self.names)
        return read_yaml(path), str(path)

    def load(self, schema: type[Schema], name: str | Path, base: Mapping[str, Any] | None = None) -> Schema:
        """Check the values of `name` against `schema`; they replace those of `base` key by key.

        Raises
        ------
        models.checked_yaml.ConfigError
            As for `read`, or if a value is wrong.
        """
        values, where = self.read(name)
        return check(schema, merge_mappings(base, values) if base and isinstance(values, Mapping) else values, where)


@lru_cache
def _entries(path: Path) -> Mapping[str, Any]:
    entries: Mapping[str, Any] = read_yaml(path)
    return entries


def is_file(path: str | Path) -> bool:
    """Return True if `path` is a file; False also for a name that is too long, for which `Path.is_file` raises."""
    return os.path.isfile(path)  # noqa: PTH113


def shipped_names(folder: Path) -> tuple[str, ...]:
    """List the YAML files in `folder`, sorted, without their ending."""
    return tuple(sorted(path.stem for path in folder.glob("*.yaml")))


# The first line of a YAML file, by which editors find its schema.


EDITOR_LINE = "# yaml-language-server: $schema="
"""Start of that line, which continues with the place of the schema relative to the file."""


def kept_editor_line(path: Path) -> str:
    """Return that line of the file at `path` for its replacement; empty without one."""
    with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8") as file:
        first = file.readline()
        return first if first.startswith(EDITOR_LINE) else ""
    return ""
