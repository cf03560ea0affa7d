"""Study `peers`: tune the gains of every peer, and check that neighbouring gains are not better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml
from pydantic import Field
from scipy.stats import qmc

from diffdrive_mpc.bench.case import MAX_CASES
from diffdrive_mpc.bench.peers import LAWS
from diffdrive_mpc.bench.peers.tracking_peer import law_kind, make_tracking_peer
from diffdrive_mpc.bench.progress import ProgressBar
from diffdrive_mpc.bench.runner import run_tasks
from diffdrive_mpc.bench.study import Report, Study
from diffdrive_mpc.bench.table import Table, number
from diffdrive_mpc.models.checked_yaml import ConfigError, StrictModel, load_checked
from diffdrive_mpc.models.interface import FloatArray
from diffdrive_mpc.models.suggestions import format_unknown_name
from diffdrive_mpc.mpc import load_trajectory
from diffdrive_mpc.sim import make_plant, simulate

# Search with a fixed number of evaluations: a Sobol scan, then refinement of the best setting, gain by gain.


Values = dict[str, float]
Objective = Callable[[Values], float]
_DIGITS = 4
"""Number of significant digits of the gains."""


@dataclass
class GainSearch:
    """Minimiser of a function of positive variables within ranges, on a logarithmic scale.

    Attributes
    ----------
    objective
        Function to minimise.
    ranges
        Minimum and maximum of each variable.
    evaluations
        Maximum number of calls of `objective`.
    trials
        Evaluated settings and their objectives, in order of evaluation.
    """

    objective: Objective
    ranges: Mapping[str, tuple[float, float]]
    evaluations: int
    trials: list[tuple[Values, float]] = field(default_factory=list)

    @property
    def best(self) -> tuple[Values, float]:
        """First setting with the minimum objective, and its objective."""
        return min(self.trials, key=lambda row: row[1])

    def scan(self, count: int, seed: int) -> None:
        """Evaluate the middle of the ranges and `count` - 1 points of a scrambled Sobol sequence."""
        low, high = np.log(np.array(list(self.ranges.values()), dtype=float)).T
        points = qmc.Sobol(len(low), seed=seed).random_base2(int(np.ceil(np.log2(max(count, 2)))))
        for point in [np.full(len(low), 0.5), *points][:count]:
            self._evaluate(dict(zip(self.ranges, np.exp(low + point * (high - low)).tolist(), strict=True)))

    def refine(self, factor: float) -> None:
        """Multiply or divide each variable in turn by `factor`; reduce `factor` if no step decreases the objective.

        The search ends at a factor below 1.01, or if no evaluations remain.
        """
        while len(self.trials) < self.evaluations:
            former_minimum = self.best[1]
            for name in self.ranges:
                if not self._step(name, factor):
                    self._step(name, 1 / factor)
            if self.best[1] >= former_minimum:
                factor = float(np.sqrt(factor))
                if factor < 1.01:
                    return

    def _step(self, name: str, factor: float) -> bool:
        """Multiply a variable by `factor` as long as the objective decreases; return True if it has decreased."""
        has_improved = False
        while len(self.trials) < self.evaluations:
            values, minimum = self.best
            low, high = self.ranges[name]
            candidate = values | {name: float(np.clip(values[name] * factor, low, high))}
            if candidate == values or not self._evaluate(candidate) < minimum:
                return has_improved
            has_improved = True
        return has_improved

    def _evaluate(self, values: Values) -> float:
        setting = {name: float(f"{value:.{_DIGITS}g}") for name, value in values.items()}
        for trial, objective in self.trials:
            if trial == setting:
                return objective
        objective = self.objective(setting)
        self.trials.append((setting, objective))
        return objective


GAINS_FILE = "gains.yaml"
TUNED_PEERS = (*LAWS, "mppi", "mppi+slip")
"""Names of the peers with gains, in the order of their file."""
_FOLDER = Path(__file__).parent
_INCOMPLETE_ERROR = 1.0
"""Position RMSE that counts for a run that does not complete [m]."""
Count = Annotated[int, Field(ge=1, le=MAX_CASES)]


class PeersSettings(StrictModel):
    """Settings for the tuning of peers; `settings.yaml` describes each setting."""

    plant: str
    runs: dict[str, tuple[Annotated[int, Field(ge=0)], ...]]
    evaluations: Count
    scan: Count
    first_factor: Annotated[float, Field(gt=1)]
    search_seed: int
    proof: tuple[float, ...]
    ranges: dict[str, dict[str, tuple[float, float]]]


def load_settings(path: Path | None = None, *, quick: bool = False) -> PeersSettings:
    """Load the settings; raise ConfigError if the file is invalid."""
    return load_checked(PeersSettings, path or _FOLDER / ("quick.yaml" if quick else "settings.yaml"))


@dataclass(frozen=True)
class Neighbour:
    """Runs with one gain multiplied by a factor; `increase` (runs,) is the increase of the position RMSE [m]."""

    gain: str
    factor: float
    increase: FloatArray

    @property
    def spread(self) -> float:
        """Standard error of the mean of `increase` [m]."""
        return float(np.std(self.increase, ddof=1) / np.sqrt(len(self.increase))) if len(self.increase) > 1 else 0.0


@dataclass(frozen=True)
class TunedPeer:
    """Best gains of a peer, their mean position RMSE [m], all evaluated settings, and runs with neighbouring gains."""

    peer: str
    gains: Values
    rmse: float
    trials: Sequence[tuple[Values, float]]
    neighbours: Sequence[Neighbour]


def position_errors(settings: PeersSettings, peer: str, values: Values) -> FloatArray:
    """Compute the position RMSE (runs,) of a peer with gains `values` [m]."""
    gains, errors = law_kind(peer).gains(**values), []
    for trajectory, seeds in settings.runs.items():
        reference = load_trajectory(trajectory)
        for seed in seeds:
            run = simulate(make_tracking_peer(peer, gains), make_plant(settings.plant, seed=seed), reference)
            error = (run.true_pose - run.reference_pose)[run.counted, :2]
            errors.append(_INCOMPLETE_ERROR if run.ended else float(np.sqrt(np.mean(np.sum(error * error, axis=1)))))
    return np.array(errors)


def tune(settings: PeersSettings, peer: str) -> TunedPeer:
    """Search for the best gains of a peer within the budget, then evaluate neighbouring gains."""
    errors = partial(position_errors, settings, peer)
    search = GainSearch(
        lambda values: float(errors(values).mean()), settings.ranges[peer.partition("+")[0]], settings.evaluations
    )
    search.scan(settings.scan, settings.search_seed)
    search.refine(settings.first_factor)
    gains, rmse = search.best
    best = errors(gains)
    neighbours = [
        Neighbour(name, factor, errors(gains | {name: value * factor}) - best)
        for name, value in gains.items()
        for factor in settings.proof
    ]
    return TunedPeer(peer, gains, rmse, search.trials, neighbours)


class PeersStudy(Study[list[str], list[TunedPeer]]):
    """Study that tunes peers.

    Parameters
    ----------
    settings
        Settings of the study.
    only
        Names of peers; by default all peers with ranges in the settings.
    """

    name, title = "peers", "Tuning of the peers, and effect of each gain"

    def __init__(self, settings: PeersSettings, only: Sequence[str] | None = None) -> None:
        self._settings, self._only = settings, only

    def plan(self) -> list[str]:
        """Return the names of the peers; the slowest are first, because a long task at the end leaves cores idle."""
        tunable = [name for name in TUNED_PEERS if name.partition("+")[0] in self._settings.ranges]
        selected = tunable if self._only is None else list(self._only)
        for name in selected:
            if name not in tunable:
                raise ConfigError(f"--peers: unknown peer {format_unknown_name(name, tunable)}")
        return sorted(selected, key=lambda name: not name.startswith("mppi"))

    def run(self, plan: list[str], jobs: int, bar: ProgressBar) -> list[TunedPeer]:
        """Tune each peer in one task."""
        bar.start_stage("tuning", len(plan))
        return run_tasks([partial(tune, self._settings, name) for name in plan], jobs, bar.advance)

    def report(self, results: list[TunedPeer], seconds: float) -> Report:
        """Build the report with the tuned gains and the effects of neighbouring gains."""
        settings = self._settings
        runs = ", ".join(f"{Path(name).stem} ({', '.join(map(str, seeds))})" for name, seeds in settings.runs.items())
        facts = [
            f"{len(results)} peers, {settings.evaluations} settings each, {settings.scan} of them a Sobol scan; "
            f"plant {settings.plant}; trajectories (seeds): {runs}; in {seconds:.0f} s."
        ]
        rows = [
            {"peer": result.peer, "gains": result.gains, "position_rmse_m": result.rmse, "tried": list(result.trials)}
            for result in results
        ]
        neighbour_rows = [
            {
                "peer": result.peer,
                "gain": neighbour.gain,
                "factor": neighbour.factor,
                "worse_m": float(neighbour.increase.mean()),
                "se_m": neighbour.spread,
            }
            for result in results
            for neighbour in result.neighbours
        ]
        meta: dict[str, object] = {"settings": settings.model_dump(mode="json")}
        tables = [_tuning_table(results, settings.scan), *(_neighbours_table(result) for result in results)]
        return Report(f"{len(rows)} peers", meta, {"peers": rows, "proof": neighbour_rows}, facts, tables)


def _tuning_table(results: Sequence[TunedPeer], scan: int) -> Table:
    columns = ("peer", "after the scan [mm]", "tuned [mm]", "settings", "better neighbours", "significant")
    rows = []
    for result in results:
        better = [neighbour for neighbour in result.neighbours if neighbour.increase.mean() < 0]
        significant = [neighbour for neighbour in better if -neighbour.increase.mean() > 2 * neighbour.spread]
        counts = (str(len(result.trials)), str(len(better)), str(len(significant)))
        rows.append(
            (
                result.peer,
                number(1e3 * min(rmse for _, rmse in result.trials[:scan]), 2),
                number(1e3 * result.rmse, 2),
                *counts,
            )
        )
    note = (
        "Mean position RMSE of the runs. Neighbours: one gain multiplied by a factor; significant: better by more than "
        "two standard errors of the mean difference."
    )
    return Table("Tuning", columns, tuple(rows), 1, note)


def _neighbours_table(peer: TunedPeer) -> Table:
    factors = sorted({neighbour.factor for neighbour in peer.neighbours})
    fields = law_kind(peer.peer).gains.model_fields
    columns = ("gain", "meaning", "value", *(f"x {factor:g} [mm]" for factor in factors))
    rows = []
    for name, value in peer.gains.items():
        by_factor = {neighbour.factor: neighbour for neighbour in peer.neighbours if neighbour.gain == name}
        cells = [f"{1e3 * by_factor[f].increase.mean():+.2f} ± {1e3 * by_factor[f].spread:.2f}" for f in factors]
        rows.append((name, str(fields[name].description), f"{value:g}", *cells))
    note = f"Change of the mean position RMSE of {1e3 * peer.rmse:.2f} mm, ± standard error over the runs."
    return Table(f"Neighbours of {peer.peer}", columns, tuple(rows), 2, note)


def gains_text(results: Sequence[TunedPeer], settings: PeersSettings) -> str:
    """Format the gains of the peers in `bench/peers` and in `packages/extras` as one file."""
    header = (
        "# Gains of the peers; the fields of each law state the units. `python -m studies peers` writes this file\n"
        f"# after a search of {settings.evaluations} settings for each peer, see studies/peers/settings.yaml. The\n"
        "# comment of a peer is the mean position RMSE of its tuning runs.\n"
    )
    lines: list[str] = []
    for result in sorted(results, key=lambda result: TUNED_PEERS.index(result.peer)):
        text = yaml.safe_dump({result.peer: dict(result.gains)}, sort_keys=False, default_flow_style=False)
        lines.append(text.replace(":\n", f":  # {1e3 * result.rmse:.2f} mm\n", 1))
    return header + "".join(lines)
