"""All rules, part by part."""

from __future__ import annotations

from diffdrive_mpc.bench.reproduce.findings.cost import cost_findings
from diffdrive_mpc.bench.reproduce.findings.finding import Finding
from diffdrive_mpc.bench.reproduce.findings.mbm_and_sm import mbm_sm_findings
from diffdrive_mpc.bench.reproduce.findings.state_space import ssm_findings
from diffdrive_mpc.bench.reproduce.findings.virtual_track import virtual_track_findings
from diffdrive_mpc.bench.reproduce.published import load_published
from diffdrive_mpc.bench.reproduce.results import Reproduction


def find(results: Reproduction) -> list[Finding]:
    """Every rule that the parts of `results` can decide."""
    published = load_published()
    findings: list[Finding] = []
    if results.mbm_sm:
        findings += mbm_sm_findings(results.mbm_sm, published)
    if results.ssm:
        findings += ssm_findings(results.ssm, published)
    if results.cost is not None:
        findings += cost_findings(results.cost, published)
    if results.virtual_track is not None:
        findings += virtual_track_findings(results.virtual_track, published)
    return findings
