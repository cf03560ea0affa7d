"""Revisions quoted by tracked files: each is a commit of this repository."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
_HEX = r"`?([0-9a-f]{7,40})\+?`?"
QUOTED = re.compile(rf'\brevisions?"?:?\s+"?{_HEX}\b(?:(?:,| to| and| or)\s+{_HEX}\b)?', re.IGNORECASE)


def git(*arguments: str, text: str = "") -> str:
    """Return the output of git in the repository; empty on failure."""
    try:
        result = subprocess.run(["git", *arguments], cwd=ROOT, input=text, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return result.stdout if result.returncode == 0 else ""


def quoted_revisions(text: str) -> set[str]:
    """Return the revisions that a text quotes."""
    quoted = {revision for match in QUOTED.finditer(text) for revision in match.groups() if revision}
    # Dates and other decimal numbers are not revisions.
    return {revision for revision in quoted if re.search("[a-f]", revision) or len(revision) > 8}


def test_every_quoted_revision_is_a_commit_of_this_repository():
    if not (ROOT / ".git").exists() or git("rev-parse", "--is-shallow-repository").strip() != "false":
        pytest.skip("needs a clone with its whole history")
    quoted: dict[str, list[str]] = {}
    for name in git("ls-files", "-z").split("\0"):
        path = ROOT / name
        if not name or path == Path(__file__) or not path.is_file():
            continue
        for revision in quoted_revisions(path.read_bytes().decode("utf-8", "replace")):
            quoted.setdefault(revision, []).append(name)
    assert quoted
    checked = git("cat-file", "--batch-check", text="".join(f"{revision}^{{commit}}\n" for revision in quoted))
    missing = [
        quoted[revision] for revision, line in zip(quoted, checked.splitlines(), strict=True) if " commit " not in line
    ]
    assert not missing
