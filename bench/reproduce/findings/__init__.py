"""What the papers found, as rules, and whether they hold on the simulated robot. The rules decide, nobody else."""

from diffdrive_mpc.bench.reproduce.findings.all_findings import find
from diffdrive_mpc.bench.reproduce.findings.finding import Finding

__all__ = ["Finding", "find"]
