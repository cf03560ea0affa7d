"""Tables generated from declarations are current and complete."""

from itertools import chain
from pathlib import Path

import pytest

from diffdrive_mpc.mpc.config.described import feature_rows, schema_rows
from studies.documents import declared_tables

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("name", declared_tables.PAGES)
def test_page_shows_the_declared_tables(name):
    page = (DOCS / name).read_text(encoding="utf-8")
    assert declared_tables.with_tables(name, page) == page, "run: python -m studies.documents.declared_tables"


def test_every_parameter_has_a_row_with_unit_default_and_advice():
    lines = [line for line in declared_tables.parameter_tables().splitlines() if line.startswith("| `")]
    parameters = [row for row in (*schema_rows(), *feature_rows()) if not row.key.startswith("terms")]
    # Lists, which come only from files, are in the last table.
    controller = sorted(parameters, key=lambda row: row.default.startswith("["))
    rows = [*declared_tables.node_rows(), *chain(*declared_tables.part_rows().values()), *controller]
    assert [line.split("`")[1] for line in lines] == [row.key for row in rows]
    for line in lines:
        _, _, unit, default, _, meaning, advice, _ = line.replace("\\|", "¦").split("|")
        assert default.strip() and meaning.strip() and advice.strip(), line
        assert unit.strip() or "provenance" in line, line
