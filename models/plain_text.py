"""Text from outside, such as names in files and of files, made safe to show: it is data wherever it stands."""

from __future__ import annotations

LONGEST = 1000
"""Characters of a line at most."""


def plain_line(text: str, longest: int = LONGEST) -> str:
    r"""`text` as one line that steers neither a terminal nor a parser of lines.

    White space is one blank each, other characters that cannot be printed stand as escapes such as ``\x1b``, and what
    is longer than `longest` characters is cut, which "..." shows.
    """
    cut = text[: 4 * longest]  # what follows cannot be shown, and need not be looked at
    line = " ".join("".join(one if one.isprintable() or one.isspace() else _escape(one) for one in cut).split())
    return line if len(line) <= longest and len(cut) == len(text) else f"{line[: longest - 3]}..."


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
