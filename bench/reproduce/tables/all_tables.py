"""All tables, the findings first."""

from __future__ import annotations

from collections.abc import Sequence

from diffdrive_mpc.bench.reproduce.findings import Finding, find
from diffdrive_mpc.bench.reproduce.published import load_published
from diffdrive_mpc.bench.reproduce.results import Reproduction
from diffdrive_mpc.bench.reproduce.tables.cost import cost_table
from diffdrive_mpc.bench.reproduce.tables.mbm_and_sm import fit_table, odometry_tables
from diffdrive_mpc.bench.reproduce.tables.state_space import free_drive_tables, order_table
from diffdrive_mpc.bench.reproduce.tables.virtual_track import virtual_track_table
from diffdrive_mpc.bench.table import Table


def report_tables(results: Reproduction) -> list[Table]:
    """Tables of the parts that were run."""
    published = load_published()
    tables = [findings_table(find(results), len(results.study.repetitions))]
    if results.mbm_sm:
        tables += [fit_table(results.mbm_sm, published), *odometry_tables(results.mbm_sm, published)]
    if results.ssm:
        tables += [order_table(results.ssm, published), *free_drive_tables(results.ssm, published)]
    if results.cost is not None:
        tables.append(cost_table(results.cost, published))
    if results.virtual_track is not None:
        tables.append(virtual_track_table(results.virtual_track))
    return tables


def findings_table(findings: Sequence[Finding], repetitions: int) -> Table:
    """Every rule with its verdict."""
    rows = tuple((one.claim, one.source, one.published, one.plant, one.verdict) for one in findings)
    count = "one repetition" if repetitions == 1 else f"{repetitions} repetitions, with drives and noise of their own"
    note = f"From {count}. Holds: in all (yes), in none (no), or in how many. Numbers are means over repetitions."
    columns = ("finding", "source", "published", "on our plant", "holds")
    return Table("Findings", columns, rows, text_columns=len(columns), note=note)
