"""Rules on the virtual track (Botta et al., Appl. Sci. 2021, 11(4), 1594)."""

from __future__ import annotations

from diffdrive_mpc.bench.reproduce.experiments.virtual_track import TrackLine, VirtualTrackResult
from diffdrive_mpc.bench.reproduce.findings.finding import Finding
from diffdrive_mpc.bench.reproduce.published import Published


def virtual_track_findings(result: VirtualTrackResult, published: Published) -> list[Finding]:
    """Whether the printed tests can be those behind the printed line."""
    certain = published.rules.certain
    within = f"within {certain:g} standard deviations"
    return [
        _agrees(f"the printed tests give the printed p1 {within}", result.printed, result.fitted, certain),
        _agrees(
            f"with tracks exchanged (tests 1, 2 with 7, 8; ours) they give the printed p1 {within}",
            result.printed,
            result.fitted_exchanged,
            certain,
        ),
    ]


def _agrees(claim: str, printed: TrackLine, fitted: TrackLine, certain: float) -> Finding:
    return Finding(
        claim,
        "P3, section 3 and Table 1",
        f"{printed.p1:.3f} m s",
        f"{fitted.p1:.3f} ± {fitted.p1_deviation:.3f} m s (no drive: the paper's rows)",
        (abs(fitted.p1 - printed.p1) < certain * fitted.p1_deviation,),
    )
