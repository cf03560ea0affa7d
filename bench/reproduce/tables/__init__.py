"""The tables of the report: the papers' figures beside those of the simulated robot."""

from diffdrive_mpc.bench.reproduce.tables.all_tables import report_tables

__all__ = ["report_tables"]
