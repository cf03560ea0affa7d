"""What the papers found, as rules, and whether they hold on the simulated robot. The rules decide, nobody else."""

from bench.reproduce.findings.all_findings import find
from bench.reproduce.findings.finding import Finding

__all__ = ["Finding", "find"]
