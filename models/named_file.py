"""Parameter files given by a short name or by a path."""

from __future__ import annotations

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
from diffdrive_mpc.models.suggestions import similar_name
from diffdrive_mpc.models.trust import check_trusted


def named_file(
    kind: str, folder: Path, name: str | Path, shipped: Sequence[str] | None = None, others: str = ""
) -> Path:
    """Resolve `name` to a file: a YAML file shipped in `folder`, or a file of the user.

    Parameters
    ----------
    kind
        Kind of the files, for the message.
    folder
        Folder of the shipped files.
    name
        Name of a shipped file without its suffix, or a path.
    shipped
        Names of the shipped files; by default every YAML file in `folder`.
    others
        Further accepted values, which the message lists after the shipped names.

    Raises
    ------
    models.checked_yaml.ConfigError
        If no such file exists; the message lists the shipped names and suggests the most similar one.
    models.errors.ArgumentError
        If `name` is neither a string nor a path.
    models.trust.UntrustedFileError
        If the file must not be opened, see `models.trust.only_trusted`.
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
    path = Path(text)
    if is_file(f"{text}.yaml"):
        hint = f"; did you mean '{text}.yaml'?"
    elif path.suffix:  # a path is not a misspelt name, except for the name of a shipped file with its suffix
        hint = similar_name(path.stem, {path.stem} & {*known})
    else:
        hint = similar_name(text, known)
    missing = "there is no such file; " if looks_like_path(text) else ""
    if path.is_dir():
        inside = sorted(path.glob("*.yaml"))
        files = ", ".join(file.name for file in inside)
        # Folders of identify contain model.yaml, config.yaml, robot.yaml and surface.yaml.
        fitting = [file for file in inside if kind.startswith(file.stem)]
        hint = f"; did you mean '{fitting[0]}'?" if fitting else hint
        missing = f"a folder {f'with {files}' if files else 'without YAML files'}; " if text.strip() else "empty; "
    raise ConfigError(
        f"unknown {kind} '{text}': {missing}give one of {', '.join(known)}{others} or the path of a {kind} file{hint}"
    )


@dataclass(frozen=True)
class EntryFile:
    """Shipped YAML file with named entries; a file of the user contains a single entry without a name.

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
        """Return the values of a shipped entry or of a user's file, and their location for messages.

        Raises
        ------
        models.checked_yaml.ConfigError
            If there is no such entry or file, or the file cannot be read. Other errors as for `named_file`.
        """
        entries = _entries(self.path)
        if isinstance(name, (str, Path)) and str(name) in entries:
            return deepcopy(entries[str(name)]), f"{self.path}, entry '{name}'"
        path = named_file(self.kind, self.path, name, self.names)
        return read_yaml(path), str(path)

    def load(self, schema: type[Schema], name: str | Path, base: Mapping[str, Any] | None = None) -> Schema:
        """Merge the values of `name` into `base`, and check the result against `schema`.

        Raises
        ------
        models.checked_yaml.ConfigError
            As for `read`, or if a value is invalid.
        """
        values, where = self.read(name)
        return check(schema, merge_mappings(base, values) if base and isinstance(values, Mapping) else values, where)


@lru_cache
def _entries(path: Path) -> Mapping[str, Any]:
    entries: Mapping[str, Any] = read_yaml(path)
    return entries


def is_file(path: str | Path) -> bool:
    """Return True if `path` is a file; return False for a name that is too long, where `Path.is_file` would raise."""
    return os.path.isfile(path)  # noqa: PTH113


def looks_like_path(name: str) -> bool:
    """Return True if `name` has a suffix or a folder, so that it is no short name."""
    return bool(Path(name).suffix) or os.sep in name


def shipped_names(folder: Path) -> tuple[str, ...]:
    """List the names of the YAML files in `folder`, sorted, without suffix."""
    return tuple(sorted(path.stem for path in folder.glob("*.yaml")))


# First line of a YAML file, which refers editors to the schema.


EDITOR_LINE = "# yaml-language-server: $schema="
"""Start of the line; the path of the schema, relative to the file, follows."""


def read_editor_line(path: Path) -> str:
    """Return the schema line of the file at `path`, to preserve it in a new version; empty if there is none."""
    with suppress(OSError, UnicodeDecodeError), path.open(encoding="utf-8") as file:
        first = file.readline()
        return first if first.startswith(EDITOR_LINE) else ""
    return ""
