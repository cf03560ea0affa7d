"""Study of the proof of a controller: runs, maps, boundaries, and output files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from diffdrive_mpc.bench.case import Case
from diffdrive_mpc.bench.plain_values import plain
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.run_row import STATISTICS
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.models.checked_yaml import ConfigError
from diffdrive_mpc.models.load import is_shipped
from diffdrive_mpc.mpc import load_config
from diffdrive_mpc_extras.campaign.definition import Definition
from diffdrive_mpc_extras.campaign.draws import Value
from diffdrive_mpc_extras.campaign.engine import CampaignPlace, CampaignRun, drive_all
from diffdrive_mpc_extras.campaign.repeat import write_run
from diffdrive_mpc_extras.campaign.run import import_arrow, write_table
from diffdrive_mpc_extras.proof.proof_file import Boundary, DrivenMap, Proof, drawn_map, find_boundaries, map_runs
from diffdrive_mpc_extras.proof.report import (
    Outcomes,
    error_estimates,
    facts,
    map_chart,
    shown,
    tables,
    tail_charts,
    worst,
)

RESULTS, WORST = "prove.parquet", "worst"
_CONTROLLER = ("controller", "model", "config")


@dataclass(frozen=True)
class ProofPlan:
    """Drawn runs, and the base run of maps and searches."""

    drawn: list[Definition]
    probe: Definition


@dataclass(frozen=True)
class ProofResults:
    """Results of a proof.

    Attributes
    ----------
    driven
        Drawn runs, in order.
    maps, boundaries
        Results of maps and searches.
    others
        Number of runs of maps and searches.
    worst
        Worst runs by file name.
    """

    driven: list[CampaignRun]
    maps: list[DrivenMap]
    boundaries: list[Boundary]
    others: int
    worst: dict[str, CampaignRun] = field(default_factory=dict)


class ProofStudy(Study[ProofPlan, ProofResults]):
    """Study of one controller: drawn runs, maps and boundaries.

    Parameters
    ----------
    config
        Configuration of the controller: a file, or the name of a shipped one.
    proof
        Campaign, maps and boundaries.
    place
        Store and number of processes.
    runs
        Number of drawn runs; by default that of the proof.
    worst_runs
        Number of worst runs that are written as files.
    """

    name = "prove"
    title = "Proof"
    shared = True

    def __init__(
        self, config: str, proof: Proof, place: CampaignPlace, runs: int | None = None, worst_runs: int = 10
    ) -> None:
        self._config, self._proof, self._place, self._runs, self._worst_runs = config, proof, place, runs, worst_runs

    def plan(self) -> ProofPlan:
        """Draw the runs; raises ConfigError if the campaign names a controller."""
        import_arrow()
        forbidden = [name for name in _CONTROLLER if name in (*self._proof.factors, *self._proof.probe.factors)]
        if forbidden:
            raise ConfigError(f"factors.{forbidden[0]}: remove it; the controller under test is {self._config}")
        factors = controller_factors(self._config)
        probe = Definition.from_factors(dict(self._proof.probe.factors) | dict(factors), "probe")
        return ProofPlan(
            [definition.with_factors(factors) for definition in self._proof.definitions(self._runs)], probe
        )

    def cases(self, plan: ProofPlan) -> Iterable[Case]:
        """Return the case of the base run."""
        return [plan.probe.case]

    def run(self, plan: ProofPlan, jobs: int, bar: ProgressBar) -> ProofResults:
        """Simulate all runs that are not stored yet."""
        place, proof = replace(self._place, jobs=jobs), self._proof
        driven = drive_all(plan.drawn, place, bar, "driving runs")
        map_definitions = [map_runs(axes, plan.probe, proof.probe.seeds[0]) for axes in proof.maps.values()]
        mapped = drive_all([run for runs in map_definitions for run in runs], place, bar, "driving maps")
        maps = [drawn_map(*item, runs, mapped) for item, runs in zip(proof.maps.items(), map_definitions, strict=True)]
        tried: dict[str, CampaignRun] = {run.key: run for run in mapped}

        def drive(runs: list[Definition]) -> list[CampaignRun]:
            outcomes = drive_all(runs, place, bar, "searching boundaries")
            tried.update((outcome.key, outcome) for outcome in outcomes)
            return outcomes

        boundaries = find_boundaries(proof.boundaries, plan.probe, proof.probe.seeds, drive, proof.band)
        worst_runs = worst(driven, self._worst_runs)
        files = {f"{k:02d}.yaml": run for k, run in enumerate(worst_runs, start=1)}
        return ProofResults(driven, maps, boundaries, len(tried), files)

    def report(self, results: ProofResults, seconds: float) -> Report:  # noqa: ARG002 - not used
        """Return the report with tables, and figures of the errors and of each map."""
        estimates, tail = error_estimates(results.driven), tail_charts(results.driven)
        figures = ({"errors.png": tail} if tail else {}) | {
            f"map-{proof_map.name}.png": [map_chart(proof_map)] for proof_map in results.maps
        }
        seeds, band = len(self._proof.probe.seeds), self._proof.band
        return Report(
            size=f"{len(results.driven) + results.others} runs",
            meta={"statistics": STATISTICS, "controller": Path(self._config).name, "campaign": self._proof.description},
            content={
                "rates": plain(Outcomes.of_runs(results.driven, band)),
                "band_m": band,
                "position_rmse_m": plain(estimates),
                "boundaries": [_boundary_row(boundary) for boundary in results.boundaries],
            },
            facts=[f"{Path(self._config).name}: {self._proof.description}.", *facts(results.driven, results.others)],
            notes=[f"Errors: {STATISTICS}."],
            tables=tables(results.driven, results.boundaries, results.worst, seeds, band),
            figures=figures,
            shown=shown(self._config, results.driven, results.boundaries, band),
        )


def write_proof(results: ProofResults, out: Path) -> None:
    """Write the table of the drawn runs and the worst runs into `out`; raises ConfigError if this fails."""
    write_table([run.columns for run in results.driven], out / RESULTS)
    for old in (out / WORST).glob("[0-9][0-9].yaml"):
        old.unlink()
    for name, run in results.worst.items():
        write_run(run, out / WORST / name)


def controller_factors(config: str) -> Mapping[str, Value]:
    """Return the factors of a controller; raises ConfigError if the configuration does not exist."""
    load_config(config)
    return {"model": config} if is_shipped(config) else {"config": config, "model": load_config(config).model}


def _boundary_row(boundary: Boundary) -> dict[str, object]:
    tried = {f"{value:g}": count for value, count in boundary.values.items()}
    return {"factor": boundary.factor, "held": boundary.held, "failed": boundary.failed, "tried": tried}
