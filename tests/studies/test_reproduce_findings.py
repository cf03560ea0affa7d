"""Reproduction of the papers: a short run of the command, and the tables of its page."""

import re
from pathlib import Path

import pytest

from commands import invoke
from diffdrive_mpc.bench.report_folder import CONTENTS
from studies.cli import app
from studies.documents.documents import REPRODUCE, sections


def test_tables_of_the_page_are_in_the_report() -> None:
    docs = Path(__file__).parents[2] / "docs"
    parts = sections(REPRODUCE, (docs / "reproduce" / "reproduce.md").read_text(encoding="utf-8"))
    tables = re.findall(r"<!-- (reproduce-[a-z-]+):begin -->", (docs / "reproduce.md").read_text(encoding="utf-8"))
    assert {"reproduce-runs", "reproduce-findings"} <= set(tables) <= set(parts)


@pytest.mark.system
def test_command_writes_its_report(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke(app, "reproduce", "--out", out, "--quick", "--only", "virtual_track")
    files = {"figures", "report.html", "reproduce.json", "reproduce.md", CONTENTS}
    assert {path.name for path in out.iterdir()} == files
    assert "-0.022 ± 0.021" in result.stdout
